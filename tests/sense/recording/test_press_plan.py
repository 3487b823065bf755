"""Press plans of each kind over any pad, and from files."""

import numpy as np
import pytest

from padforge.common.settings import validate
from padforge.design import Morphology
from padforge.design.settings import PadSettings
from padforge.sense.recording.press_plan import PressPlan, make_plan, read_plan
from padforge.sense.settings import RigSettings


def plan_of(size: PadSettings | None = None, **settings: object) -> PressPlan:
    pad = Morphology.straight(4 if size is None else size.layout)
    return make_plan(pad, validate(RigSettings, settings, "rig"), np.random.default_rng(0), size)


def test_plan_round_trip_and_from_file(tmp_path):
    plan = plan_of(presses=7, depths_mm=[2.0, 4.0])
    again = PressPlan.from_rows(plan.to_rows())
    assert np.array_equal(again.positions_mm, plan.positions_mm)
    assert again.depths_mm.tolist() == [2, 4, 2, 4, 2, 4, 2]
    assert set(plan_of(presses=30).depths_mm) == {5.0}
    (tmp_path / "gaps.csv").write_text("x_mm,y_mm\n1,2\n\n-3.5,4\n\n")
    assert read_plan(tmp_path / "gaps.csv", (2.5, 1)).to_rows() == [[1, 2, 2.5], [-3.5, 4, 1]]
    (tmp_path / "deep.csv").write_text("x_mm,y_mm,depth_mm\n1,2,1.5\n")
    assert read_plan(tmp_path / "deep.csv", (3.0,)).to_rows() == [[1, 2, 1.5]]


def test_make_plan_of_grids_row_by_row():
    line = [-22.5, 0.0, 22.5]
    rows = [[x, y] for y in line for x in line]
    assert plan_of(presses=8, plan="grid").positions_mm.tolist() == rows[:8]
    serpentine = [*rows[:3], *rows[5:2:-1], *rows[6:]]
    assert plan_of(presses=9, plan="serpentine").positions_mm.tolist() == serpentine
    assert plan_of(presses=1, plan="grid").positions_mm.tolist() == [[0, 0]]
    uniform = plan_of(presses=2000).positions_mm
    assert np.abs(uniform).max() > 22.4
    np.testing.assert_allclose(uniform.mean(axis=0), 0, atol=1.5)


@pytest.mark.parametrize("counts", [(3, 6), (9, 1)])
def test_make_plan_grid_has_one_step_along_both_axes(counts: tuple[int, int]) -> None:
    size = PadSettings(horizontals=counts[0], verticals=counts[1], pitch_mm=(8.0, 15.0))
    for presses in (1, 2, 7, 60, 1500):
        positions = plan_of(size, presses=presses, plan="grid").positions_mm
        assert len(positions) == len(np.unique(positions, axis=0)) == presses
        steps = [np.diff(np.unique(positions[:, axis])) for axis in range(2)]
        if min(map(len, steps)) >= 8:
            assert steps[0].mean() == pytest.approx(steps[1].mean(), rel=0.1)


@pytest.mark.parametrize("plan", ["grid", "serpentine"])
def test_make_plan_depths_do_not_depend_on_the_position(plan):
    plan_ = plan_of(presses=361, plan=plan, depths_mm=[0.5, 1, 2, 3, 5])
    for axis in (0, 1):
        for value in np.unique(plan_.positions_mm[:, axis]):
            assert len(set(plan_.depths_mm[plan_.positions_mm[:, axis] == value])) == 5
