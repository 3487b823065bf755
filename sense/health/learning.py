import numpy as np

from sense.localizer.localizer import Localizer
from sense.recordings.recording import Recording

from .health_model import FELT, RECORDED, HealthModel


def learn_health(recording: Recording, localizer: Localizer) -> dict[str, HealthModel]:
    """Learn what the healthy pad gives from the presses of the recording that `localizer` did not hold back.

    Returns:
        By name of the files, one model for recordings whose presses were commanded, and one for those that are found.

    Raises:
        InputError: too few presses, or no living fibre.
    """
    from sense.processing.press_alignment import felt

    held = np.zeros(len(recording.presses_mm), dtype=bool)
    held[list(localizer.test)] = True
    readings, times_s = recording.readings, recording.times_s
    commanded = recording.begun, recording.lifted
    seed = int(localizer.provenance["seed"])
    return {
        name: HealthModel.fit(
            readings,
            times_s,
            begun[~held],
            lifted[~held],
            rng=np.random.default_rng(seed),
            provenance=localizer.provenance,
        )
        for name, (begun, lifted) in ((RECORDED, commanded), (FELT, felt(readings, times_s, *commanded)))
    }
