"""Simulated strokes: a finger that touches a simulated pad, slides over it in a straight line, and lifts.

At any time a stroke is like a press where the finger is then, which creeps as it was pressed so far. What a finger
leaves behind on its way is not simulated: nobody has measured it.
"""

from dataclasses import dataclass

import numpy as np

from padforge.design import Contact, Morphology
from padforge.design.settings import PadSettings
from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import make_plan, sample_uniform
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import TRAVEL_S, LivePad
from padforge.sense.simulation.simulated_recording import model_plan


@dataclass(frozen=True)
class Strokes:
    """N strokes on a simulated pad."""

    recording: Recording  # a press a stroke, where it ends; `down_command` is its first reading, `up_command` its end
    positions_mm: Array  # (N, T, 2) of the finger at each reading of a stroke


def simulate_strokes(
    pad: Morphology,
    rig: RigSettings,
    contact: Contact,
    speed_mm_s: float,
    strokes: int,
    rng: np.random.Generator,
    size: PadSettings | None = None,
) -> Strokes:
    """Simulate strokes of a speed, as long as the presses of `[rig]`, on the pad that it simulates presses on.

    They begin anywhere and go any way that stays on the pad; where it is too small for them, they are slower.
    """
    rig = rig.for_contact(contact)
    model = model_plan(pad, contact, rig, size)
    starts = sample_uniform(model.corners_mm, strokes, rng, model.free)
    ends = np.array([_end(start, speed_mm_s * _duration_s(rig), model.corners_mm, rng) for start in starts])
    n_held, n_rest = rig.readings_per_press // 2, rig.readings_per_press - rig.readings_per_press // 2
    share = np.arange(n_held) / n_held
    paths = starts[:, None] + share[:, None] * (ends - starts)[:, None]
    depth = np.minimum((np.arange(n_held) + 1) / (rig.rate_hz * TRAVEL_S), 1.0) * rig.press_depths_mm[0]
    built = np.random.default_rng(rig.seed)
    make_plan(pad, rig, built, size)  # the presses of a recording are drawn before the pad is
    positions_mm = np.concatenate([np.repeat(starts[:, None], n_rest, axis=1), paths], axis=1).reshape(-1, 2)
    depths_mm = np.tile(np.append(np.zeros(n_rest), depth), strokes)
    readings = LivePad(pad, contact, rig, rig.rate_hz, built).volts(positions_mm, depths_mm)
    first = rig.readings_per_press * np.arange(strokes) + n_rest
    recording = Recording(
        readings,
        (np.arange(len(readings)) + 1) / rig.rate_hz,
        paths[:, -1],
        down_command=first,
        up_command=first + n_held,
        source={"kind": "simulated", "rig": rig.model_dump(mode="json"), **model.source},
    )
    return Strokes(recording, paths)


def _duration_s(rig: RigSettings) -> float:
    return rig.readings_per_press // 2 / rig.rate_hz


def _end(start: Array, length_mm: float, corners_mm: Array, rng: np.random.Generator) -> Array:
    """Draw the end of a stroke, no nearer to the pad's edge than its corners; shorter where no way is long enough."""
    for shortened in 0.9 ** np.arange(60):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            end = start + shortened * length_mm * np.array([np.cos(angle), np.sin(angle)])
            if ((end >= corners_mm[0]) & (end <= corners_mm[1])).all():
                return end
    return start
