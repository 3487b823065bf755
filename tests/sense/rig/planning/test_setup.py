from pathlib import Path

import pytest

from design.common.errors import InputError
from design.common.settings import Spec
from design.pad.morphology import Morphology
from sense.rig.planning.press_plan import planned
from sense.rig.planning.setup import Order, plan_of, recorder_of
from sense.settings import RigSettings

PAD = Morphology.straight(2)
RIG = RigSettings(presses=5, channels=4)


def order(out: Path, pad: Morphology = PAD) -> Order:
    return Order(pad, RIG, Spec({}), out, "test", ())


def begun(out: Path) -> None:
    import numpy as np

    with recorder_of(order(out), RIG, planned(PAD, RIG, np.random.default_rng(0)), out, resume=False):
        pass


def test_a_resumed_recording_keeps_its_plan(tmp_path):
    begun(tmp_path / "run")
    first = plan_of(order(tmp_path / "run"), RIG, None, resume=True)
    other = RIG.model_copy(update={"seed": 9, "presses": 3})
    assert plan_of(order(tmp_path / "run"), other, None, resume=True).document() == first.document()


@pytest.mark.parametrize(("key", "value"), [("channels", 6), ("rate_hz", 5.0), ("contact_mm", 12.0)])
def test_other_settings_are_refused(tmp_path, key, value):
    begun(tmp_path / "run")
    with pytest.raises(InputError, match=rf"\[rig\] {key}: got {value}"):
        plan_of(order(tmp_path / "run"), RIG.model_copy(update={key: value}), None, resume=True)


def test_another_pad_is_refused(tmp_path):
    begun(tmp_path / "run")
    with pytest.raises(InputError, match="another pad"):
        plan_of(order(tmp_path / "run", Morphology.random(2, 3, 1)), RIG, None, resume=True)


@pytest.mark.parametrize("source", ["[]", "5", '{"plan": 5}', "{}"])
def test_a_recording_without_a_plan_cannot_be_resumed(tmp_path, source):
    text = f'{{"format": "padforge-recording/1", "fibres": 4, "source": {source}}}'
    (tmp_path / "start.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="has no plan"):
        plan_of(order(tmp_path), RIG, None, resume=True)
