import numpy as np
import pytest

from design.common.errors import InputError
from design.pad.morphology import Morphology
from design.settings import PadSettings
from sense.recordings.press_plan import PressPlan, planned, read_plan
from sense.settings import RigSettings

PAD = Morphology.straight(4)


def made(**settings: object) -> PressPlan:
    return planned(PAD, RigSettings.model_validate(settings), np.random.default_rng(0))


def test_a_plan_survives_json():
    plan = made(presses=7, depths_mm=[2.0, 4.0])
    again = PressPlan.of(plan.document())
    assert np.array_equal(again.places_mm, plan.places_mm)
    assert again.depths_mm.tolist() == [2, 4, 2, 4, 2, 4, 2]


@pytest.mark.parametrize("kind", ["uniform", "grid", "boustrophedon", "adaptive"])
def test_all_kinds_stay_on_the_pad(kind):
    plan = made(presses=30, plan=kind)
    assert len(plan) == 30
    assert np.abs(plan.places_mm).max() <= 22.5
    assert set(plan.depths_mm.tolist()) == {5.0}


def test_a_serpentine_takes_short_steps():
    serpentine, grid = made(presses=36, plan="boustrophedon"), made(presses=36, plan="grid")
    step = 45 / 5
    assert np.linalg.norm(np.diff(serpentine.places_mm, axis=0), axis=1) == pytest.approx(step)
    assert np.linalg.norm(np.diff(grid.places_mm, axis=0), axis=1).max() > 4 * step
    assert {*map(tuple, serpentine.places_mm.round(6))} == {*map(tuple, grid.places_mm.round(6))}


def test_a_grid_fills_the_square_half_a_pitch_beyond_the_outer_fibres_row_by_row():
    line = [-22.5, 0.0, 22.5]
    rows = [(x, y) for y in line for x in line]
    assert made(presses=9, plan="grid").places_mm.tolist() == [list(place) for place in rows]
    assert made(presses=8, plan="grid").places_mm.tolist() == [list(place) for place in rows[:8]]
    turned = [*rows[:3], *rows[5:2:-1], *rows[6:]]
    assert made(presses=9, plan="boustrophedon").places_mm.tolist() == [list(place) for place in turned]
    assert made(presses=1, plan="grid").places_mm.tolist() == [[0, 0]]
    uniform = made(presses=2000).places_mm
    assert np.abs(uniform).max() > 22.4
    np.testing.assert_allclose(uniform.mean(axis=0), 0, atol=1.5)


def test_plans_keep_to_what_is_pressed_of_the_pad():
    for kind, presses in (("uniform", 500), ("adaptive", 500), ("grid", 9), ("boustrophedon", 9)):
        rig = RigSettings(presses=presses, plan=kind)
        places = planned(PAD, rig, np.random.default_rng(0), PadSettings(sensed_mm=(50.0, 8.0))).places_mm
        np.testing.assert_allclose(np.abs(places).max(axis=0), [25, 4], rtol=0.02)
        assert (np.abs(places) <= [25.001, 4.001]).all()
    between = planned(
        PAD, RigSettings(presses=9, plan="grid"), np.random.default_rng(0), PadSettings(sensed_mm="fibres")
    ).places_mm
    assert np.abs(between).max() == 1.5 * 11.25


@pytest.mark.parametrize("plan", ["grid", "boustrophedon"])
@pytest.mark.parametrize("presses", [400, 361])
def test_depths_of_a_grid_tell_nothing_of_the_place(plan, presses):
    made_so = made(presses=presses, plan=plan, depths_mm=[0.5, 1, 2, 3, 5])
    for axis in (0, 1):
        for value in np.unique(made_so.places_mm[:, axis]):
            assert len(set(made_so.depths_mm[made_so.places_mm[:, axis] == value])) == 5


@pytest.mark.parametrize("depth", [0.0, -1.0])
def test_presses_go_in(depth):
    with pytest.raises(InputError, match="press 1 has depth"):
        PressPlan.of([[0, 0, 1e-3], [0, 0, depth]])
    assert len(PressPlan.of([[0, 0, 1e-3]])) == 1


def test_a_plan_from_a_file(tmp_path):
    (tmp_path / "plan.csv").write_text("x_mm,y_mm\n1,2\n-3.5,4\n")
    assert read_plan(tmp_path / "plan.csv", 3.0).document() == [[1, 2, 3], [-3.5, 4, 3]]
    (tmp_path / "gaps.csv").write_text("x_mm,y_mm\n1,2\n\n-3.5,4\n\n")
    assert read_plan(tmp_path / "gaps.csv", 2.5).document() == [[1, 2, 2.5], [-3.5, 4, 2.5]]
    (tmp_path / "deep.csv").write_text("x_mm,y_mm,depth_mm\n1,2,1.5\n")
    assert read_plan(tmp_path / "deep.csv", 3.0).document() == [[1, 2, 1.5]]


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "header"),
        ("x,y\n1,2\n", "header"),
        ("x_mm,y_mm\n1,two\n", "line 2"),
        ("x_mm,y_mm\n1,2\n1\n", "line 3"),
        ("x_mm,y_mm\n", "shape"),
        ("x_mm,y_mm\n1,nan\n", "NaN"),
        ("x_mm,y_mm,depth_mm\n1,2,-1\n", "depth -1 mm"),
    ],
)
def test_a_bad_plan_is_one_clear_line(tmp_path, content, line):
    (tmp_path / "plan.csv").write_text(content)
    with pytest.raises(InputError, match=line) as refusal:
        read_plan(tmp_path / "plan.csv", 3.0)
    assert "plan.csv" in str(refusal.value)
    assert "\n" not in str(refusal.value)
