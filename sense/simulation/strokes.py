"""Simulated strokes: a finger that touches a simulated pad, slides over it in a straight line, and lifts.

At any time the pad responds as if the finger had pressed its present position since the stroke began. Residues along
the stroke are not simulated, since nobody has measured them.
"""

from dataclasses import dataclass

import numpy as np

from padforge.design import Contact, Morphology
from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import make_plan, sample_uniform
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import TRAVEL_S, LivePad
from padforge.sense.simulation.simulated_recording import model_plan


@dataclass(frozen=True)
class Strokes:
    """N strokes on a simulated pad."""

    recording: Recording  # one press for each stroke, at its end position
    positions_mm: Array  # positions (N, T, 2) of the finger, from reading `down_command` to before `up_command`


def simulate_strokes(
    pad: Morphology, rig: RigSettings, contact: Contact, speed_mm_s: float, strokes: int, rng: np.random.Generator
) -> Strokes:
    """Simulate strokes as long as the presses of `[rig]`, on the pad that `simulate` presses with the same seed.

    Start and direction are random, and a stroke stays on the pad; it is slower if the pad is too small for it.
    """
    rig = rig.for_contact(contact)
    model = model_plan(pad, contact, rig)
    n_held = rig.readings_per_press // 2
    n_rest = rig.readings_per_press - n_held
    starts = sample_uniform(model.corners_mm, strokes, rng, model.free)
    length_mm = speed_mm_s * (n_held / rig.rate_hz)
    ends = np.array([_end(start, length_mm, model.corners_mm, rng) for start in starts])
    share = np.arange(n_held) / n_held
    paths = starts[:, None] + share[:, None] * (ends - starts)[:, None]
    depth = np.minimum((np.arange(n_held) + 1) / (rig.rate_hz * TRAVEL_S), 1.0) * rig.press_depths_mm[0]
    pad_rng = np.random.default_rng(rig.seed)
    make_plan(pad, rig, pad_rng)  # `simulate` samples the presses before the pad
    positions_mm = np.concatenate([np.repeat(starts[:, None], n_rest, axis=1), paths], axis=1).reshape(-1, 2)
    depths_mm = np.tile(np.append(np.zeros(n_rest), depth), strokes)
    readings = LivePad(pad, contact, rig, rig.rate_hz, pad_rng).volts(positions_mm, depths_mm)
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


def _end(start: Array, length_mm: float, corners_mm: Array, rng: np.random.Generator) -> Array:
    """Sample the end of a stroke between the corners, nearer than `length_mm` if no direction has room for that."""
    for shortened in 0.9 ** np.arange(60):
        for angle in rng.uniform(0, 2 * np.pi, 8):
            end = start + shortened * length_mm * np.array([np.cos(angle), np.sin(angle)])
            if ((end >= corners_mm[0]) & (end <= corners_mm[1])).all():
                return end
    return start
