"""The example: a pad and a recording that resemble those of the published study, for users without a pad."""

from pathlib import Path

from padforge.common.files import provenance, sha256
from padforge.design.morphology import Morphology
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import check_new_folder
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate

# The plan is stored, since a search ends in slightly different fibres on another processor.
PLAN = Path(__file__).with_name("example_morphology.json")
PUBLISHED_RECORDING = (
    "https://github.com/tomraven1/sensor_morphology",
    "experiment/UR5RobotControlV3.2/new_test/para5_long.mat",
)
"""Repository of the authors, and the path of their recording of the built pad in it."""


def write_example(out: Path) -> Recording:
    """Write `morphology.json` and `recording/` of the example into a folder, and return the recording.

    The pad has six fibres with five knots each and is pressed on 45 x 45 mm, as in the published recording; `[rig]` and
    `[contact]` have their defaults, which were measured on that recording. Raises InputError if the folder holds
    anything but the example, or cannot be written.
    """
    path = out / "morphology.json"
    if not (path.is_file() and sha256(path) == sha256(PLAN)):
        check_new_folder(out)
    pad, rig = Morphology.load(PLAN), RigSettings()
    recording = simulate(pad, rig)
    pad.save(path)
    recording.save(out / "recording", provenance("padforge example", rig.seed, [path]), replacing=True)
    return recording
