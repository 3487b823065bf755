"""A recording and a morphology as version 0.1 wrote them, which every later version reads with the same values.

Neither file is ever written anew: if this fails, it is the reader that must still know how these were written.
"""

import shutil
from pathlib import Path

import numpy as np

from padforge.design import Morphology
from padforge.sense import Recording
from padforge.sense.formats.import_export import arm_states
from padforge.sense.recording.run_directory import Recorder

GOLDEN = Path(__file__).parent
KNOTS_MM = [  # from the middle of the pad, of 2 horizontals and 3 verticals with 2 inner knots each
    [[-16, -6], [-13.251107066484, -9.469664322824], [9.634879136906, 2.956223257801], [16, -6]],
    [[-16, 6], [-12.979930026485, -2.406119712495], [-0.669947950451, -12.242731344757], [16, 6]],
    [[-8, -18], [7.501872090485, -13.900236831433], [-3.478566420685, 0.602318535124], [-8, 18]],
    [[0, -18], [-2.218543939127, 3.12304767409], [7.606148543586, 16.416680198414], [0, 18]],
    [[8, -18], [6.275066860875, -7.457991208357], [-6.901333983751, 5.344788535993], [8, 18]],
]


def test_golden_morphology_has_its_layout_and_knots() -> None:
    pad = Morphology.load(GOLDEN / "morphology.json")
    assert (pad.layout.counts, pad.layout.pitch_x_mm, pad.layout.pitch_y_mm) == ((2, 3), 8.0, 12.0)
    np.testing.assert_allclose(pad.to_mm(pad.knots), KNOTS_MM, rtol=0, atol=1e-9)


def test_golden_recording_has_its_readings_and_presses() -> None:
    recording, nan = Recording.open(GOLDEN / "recording"), np.nan
    assert recording.digest == "4c33843cb41a2858d5b58f6972bd0e9dbe3701926a4391e56b56dbdaf3a1c1ef"
    assert recording.readings.shape == (240, 5)
    assert recording.readings[0].tolist() == [1.8253, 2.0018, 1.8164, 1.8841, 1.7527]
    assert np.argwhere(np.isnan(recording.readings)).tolist() == [[5, 2]]
    positions_mm = [[0.28, 10.81], [-8.54, 10.77], [-4.52, -1.84], [nan, nan], [6.08, 0.92]]
    np.testing.assert_array_equal(recording.presses_mm, positions_mm)  # one was stopped, and then repeated
    assert recording.down_command.tolist() == [20, 60, 100, 180, 220]
    assert recording.up_command.tolist() == [40, 80, 120, 200, 240]
    np.testing.assert_array_equal(recording.depths_mm, [2, 3, nan, 6, 7])
    np.testing.assert_array_equal(recording.reached_mm, [2.25, 3.25, nan, nan, nan])
    np.testing.assert_array_equal(recording.forces_n, [0, 1.5, nan, nan, nan])
    assert (recording.mirrored, recording.fibre_names) == (True, tuple("abcde"))
    assert Morphology.from_dict(recording.source["morphology"]) == Morphology.load(GOLDEN / "morphology.json")
    states = arm_states(GOLDEN / "recording")
    assert states is not None
    np.testing.assert_array_equal(states[:, 0], np.arange(4) * 0.1)


def test_golden_recording_goes_on(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN / "recording", tmp_path / "recording")
    with Recorder.resume(tmp_path / "recording") as recorder:
        assert (recorder.done, recorder.n_readings) == ({0, 1, 2, 3, 4}, 240)
    assert Recording.open(tmp_path / "recording") == Recording.open(GOLDEN / "recording")
