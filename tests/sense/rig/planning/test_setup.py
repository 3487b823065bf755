from pathlib import Path

import pytest

from design.common.errors import InputError
from design.pad.morphology import Morphology
from design.settings import PUBLISHED_CONTACT
from sense.rig.planning.press_plan import planned
from sense.rig.planning.setup import Setup, plan_of, recorder_of
from sense.settings import RigSettings

PAD = Morphology.straight(2)
RIG = RigSettings(presses=5, channels=4)


def setup(out: Path, pad: Morphology = PAD) -> Setup:
    return Setup(pad, PUBLISHED_CONTACT, RIG, out, "test")


def begun(out: Path) -> None:
    import numpy as np

    with recorder_of(setup(out), RIG, planned(PAD, RIG, np.random.default_rng(0)), out, resume=False):
        pass


def test_a_resumed_recording_keeps_its_plan(tmp_path):
    begun(tmp_path / "run")
    first = plan_of(setup(tmp_path / "run"), RIG, resume=True)
    other = RIG.model_copy(update={"seed": 9, "presses": 3})
    assert plan_of(setup(tmp_path / "run"), other, resume=True).document() == first.document()


@pytest.mark.parametrize(("key", "value"), [("channels", 6), ("rate_hz", 5.0), ("contact_mm", 12.0)])
def test_other_settings_are_refused(tmp_path, key, value):
    begun(tmp_path / "run")
    with pytest.raises(InputError, match=rf"\[rig\] {key}: got {value}"):
        plan_of(setup(tmp_path / "run"), RIG.model_copy(update={key: value}), resume=True)


def test_another_pad_is_refused(tmp_path):
    begun(tmp_path / "run")
    with pytest.raises(InputError, match="another pad"):
        plan_of(setup(tmp_path / "run", Morphology.random(2, 3, 1)), RIG, resume=True)


@pytest.mark.parametrize("source", ["[]", "5", '{"plan": 5}', "{}"])
def test_a_recording_without_a_plan_cannot_be_resumed(tmp_path, source):
    text = f'{{"format": "padforge-recording/1", "fibres": 4, "source": {source}}}'
    (tmp_path / "start.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="has no plan"):
        plan_of(setup(tmp_path), RIG, resume=True)


def test_a_plan_is_of_a_kind_or_from_a_file(tmp_path):
    """`--plan` and `[rig] plan` say the same."""
    (tmp_path / "places.csv").write_text("x_mm,y_mm\n1,2\n-3.5,4\n", encoding="utf-8")
    named = RigSettings(plan=str(tmp_path / "places.csv"), depth_mm=3.0)
    assert named.plan_file == tmp_path / "places.csv"
    assert plan_of(setup(tmp_path / "run"), named, resume=False).document() == [[1, 2, 3], [-3.5, 4, 3]]
    grid = RigSettings(plan="grid", presses=4)
    assert grid.plan_file is None
    assert len(plan_of(setup(tmp_path / "run"), grid, resume=False)) == 4
    with pytest.raises(InputError, match=r"\[rig\] plan: got 'grids', expected uniform, .* or a \.csv file"):
        RigSettings(plan="grids")
