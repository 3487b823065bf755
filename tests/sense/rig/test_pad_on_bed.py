"""The place of the pad from the file that fabricate writes, the contract of two packages that know nothing else."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate import build
from padforge.sense.recording.press_plan import PressPlan, make_plan
from padforge.sense.rig.config import on_bed
from padforge.sense.rig.devices import RigFault
from padforge.sense.rig.press_loop import require_safe_plan
from padforge.sense.settings import RigSettings
from tests.fabricate.planted import with_settings

PAD = Morphology.straight(2)
HALF = PAD.layout.size_mm[0] / 2
RIG = RigSettings(tcp_mm=(30.0, -5.0, -20.0), max_force_n=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pad")
    build(PAD, folder, [], with_settings({"holder": True}, printer={"bed_mm": [200.0, 180.0, 150.0]}))
    return folder


@pytest.fixture
def changed(folder, tmp_path) -> Callable[..., Path]:
    """A folder whose file has another frame, by keys; those of None are not in it."""

    def write(**frame: Any) -> Path:
        document = json.loads((folder / "fabrication.json").read_text())
        assert document["frame"]["mirrored"] is True
        document["frame"] = {k: v for k, v in (document["frame"] | frame).items() if v is not None}
        (tmp_path / "fabrication.json").write_text(json.dumps(document))
        return tmp_path

    return write


def test_the_mould_tells_all_that_a_printer_has_to_know_and_what_rig_says_counts_more(folder, changed):
    rig = on_bed(RIG, folder)
    assert (rig.pad_mm, rig.pad_angle_deg, rig.contact_mm) == ((100.0, 90.0), 0.0, 8.0)
    assert rig.box_mm == pytest.approx((100 - HALF, 100 + HALF, 90 - HALF, 90 + HALF, 3.0, 130.0), abs=1e-5)
    require_safe_plan(make_plan(PAD, rig, np.random.default_rng(0)), rig)
    box = on_bed(
        RIG.model_copy(update={"tcp_mm": (95.0, -90.0, -20.0)}), folder
    ).box_mm  # it ends where the nozzle does
    assert box is not None
    assert (box[0], box[3]) == (95, 90)
    said = RIG.model_copy(update={"pad_mm": (50.0, 60.0), "contact_mm": 9.0, "pad_angle_deg": 90.0})
    rig = on_bed(said, folder)
    assert (rig.pad_mm, rig.contact_mm, rig.pad_angle_deg) == ((50.0, 60.0), 9.0, 90.0)
    assert rig.box_mm is not None
    assert rig.box_mm[0] == 50 - HALF
    everything = rig.model_copy(update={"tcp_mm": None})
    assert on_bed(everything, folder / "nowhere") is everything
    for angle_deg, (right, top) in ((0.0, (30.0, 10.0)), (90.0, (10.0, 30.0)), (180.0, (30.0, 10.0))):
        box = on_bed(RIG, changed(pad_mm=[60.0, 20.0], angle_deg=angle_deg)).box_mm
        assert box is not None
        assert box[:4] == (100 - right, 100 + right, 90 - top, 90 + top)


@pytest.mark.parametrize(("place", "depth"), [((0.0, 0.0), 5.1), ((17.0, 0.0), 5.0), ((0.0, -17.0), 1.0)])
def test_the_tip_meets_neither_the_holder_nor_the_bed_beside_it(folder, place, depth):
    with pytest.raises(RigFault, match="no move"):
        require_safe_plan(PressPlan(np.array([place]), np.array([depth])), on_bed(RIG, folder))


@pytest.mark.parametrize(
    ("in_file", "said", "counts"),
    [(True, None, True), (True, False, False), (False, None, False), (False, True, True), (None, None, False)],
)
def test_the_holder_says_which_side_is_up_unless_rig_does(changed, in_file, said, counts):
    """A file of before that was written is of a holder that took the pad with its tracks down."""
    assert on_bed(RIG.model_copy(update={"mirrored": said}), changed(mirrored=in_file)).mirrored is counts


def test_a_pad_without_a_holder_lies_nobody_knows_where(folder, tmp_path):
    with pytest.raises(RigFault, match=r"there is no .*fabrication.json; .*holder = true") as fault:
        on_bed(RIG, tmp_path)
    assert fault.value.cause == "refused"
    document = json.loads((folder / "fabrication.json").read_text())
    (tmp_path / "fabrication.json").write_text(json.dumps(document | {"frame": None}))
    with pytest.raises(RigFault, match="a pad without a holder"):
        on_bed(RIG, tmp_path)
    with pytest.raises(RigFault, match="tcp_mm is unknown"):
        on_bed(RIG.model_copy(update={"tcp_mm": None}), folder)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("centre_mm", [1.0], "frame has no centre_mm, expected 2 finite numbers"),
        ("surface_mm", "8", "frame has no surface_mm"),
        ("bed_mm", [1, 2, None], "frame has no bed_mm, expected 3"),
        ("walls_mm", 1e9, "frame has no walls_mm"),
        ("pad_mm", [60.0, 20.0, 5.0], "frame has no pad_mm, expected 2 finite numbers"),
        ("mirrored", "up", "mirrored of frame is 'up', expected true or false"),
    ],
)
def test_a_damaged_frame_is_named(changed, key, value, said):
    with pytest.raises(InputError, match=said):
        on_bed(RIG, changed(**{key: value}))
