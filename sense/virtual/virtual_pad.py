"""A simulated pad that a finger presses at random, in real time: a converter to watch where there is no hardware."""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from padforge.design import Contact, Morphology, signals
from padforge.design.common.files import read_json
from padforge.design.common.settings import validate
from padforge.design.common.validation import InputError
from padforge.design.settings import PadSettings
from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import make_plan
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.rig.streams import RECORDED
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import SUPPLY_V, TRAVEL_S, LivePad
from padforge.sense.simulation.simulated_recording import sample_positions


class SimulatedConverter:
    """The converter of the simulated rig, `rate_hz` of which is its own; implements `Board`.

    The pad is the one that `simulate` records with the same arguments, down to the rests of its fibres. Presses come
    as often and are held as long as there, at other places, and as deep as `[rig]` says, its depths in turn.
    """

    def __init__(
        self,
        pad: Morphology,
        rig: RigSettings,
        contact: Contact,
        clock: Callable[[], float] = time.monotonic,
        size: PadSettings | None = None,
    ) -> None:
        rng = np.random.default_rng(rig.seed)
        if rig.plan_file is None:
            make_plan(pad, rig, rng, size)  # the presses of the recording, drawn before the pad is
        self._model = LivePad(pad, contact, rig, rig.rate_hz, rng)
        self._pad, self._contact, self._rig, self._clock = pad, contact, rig, clock
        self._depths_mm = rig.depths_mm or (rig.depth_mm,)
        self._size = size
        self._finger = rng.spawn(1)[0]
        self._started_s: float | None = None
        self._count = 0
        self._press, self._place_mm = -1, np.zeros(2)

    def connect(self) -> Mapping[str, Any]:
        """Begin; see `Board`."""
        signals(self._pad, self._pad.to_grid([[0.0, 0.0]]), self._contact)  # compiled before it has to keep up
        self._started_s, self._count = self._clock(), 0
        fibres = len(self._pad.knots)
        named = {"name": "simulated", "channels": fibres, "inputs": list(range(fibres))}
        return {**named, "rate_hz": self._rig.rate_hz, "supply_v": SUPPLY_V}

    def read(self) -> BoardSamples:
        """All samples since the last call; see `Board`. Raises RigFault("refused") before `connect`."""
        if self._started_s is None:
            raise RigFault("refused", "the simulated rig is not connected")
        count = math.floor((self._clock() - self._started_s) * self._rig.rate_hz)
        elapsed_s = np.arange(self._count + 1, count + 1) / self._rig.rate_hz
        self._count = count
        touches = [self._touch(at_s) for at_s in elapsed_s.tolist()]
        positions_mm = np.array([place for place, _ in touches]).reshape(-1, 2)
        volts = self._model.volts(positions_mm, np.array([depth for _, depth in touches]))
        return BoardSamples(self._started_s + elapsed_s, volts, np.zeros(len(elapsed_s), np.int64))

    def close(self) -> None:
        """Nothing is open; see `Board`."""

    def _touch(self, at_s: float) -> tuple[Array, float]:
        """Where the finger is, and how deep, mm: it comes down in the middle of a cycle and goes up at its end."""
        cycle_s = self._rig.readings_per_press / self._rig.rate_hz
        press, within_s = divmod(at_s, cycle_s)
        if press > self._press:
            self._press, self._place_mm = press, sample_positions(self._pad, 1, self._finger, self._size)[0]
        down = min((within_s - cycle_s / 2) / TRAVEL_S, 1.0, (cycle_s - within_s) / TRAVEL_S)
        return self._place_mm, self._depths_mm[int(press) % len(self._depths_mm)] * max(down, 0.0)


def virtual_pad_of(model: Path) -> SimulatedConverter:
    """Return the simulated pad whose recording a model was trained on.

    Args:
        model: folder of the model.

    Raises:
        InputError: the recording is not in the folder, or not of a simulated pad.
    """
    path = model / RECORDED / START
    if not path.is_file():
        raise InputError(f"{path}: not there, though it says which pad to simulate; name a model of `padforge run`")
    source = read_json(path, FORMAT).get("source")
    if not isinstance(source, dict) or source.get("kind") != "simulated":
        raise InputError(f"{path}: of no simulated pad, but --rig simulated needs one; --replay shows a recording")
    if "twin" in source:
        raise InputError(f"{path}: of a pad simulated by its twin, which is not live; --replay shows a recording")
    try:
        pad = Morphology.from_dict(source["morphology"])
        contact, rig = dict(source["contact"]), dict(source["rig"])
        rig.pop("channels", None)  # a simulated pad has no inputs of a board
        size = {key: source[key] for key in ("sensed_mm", "keep_out_mm") if key in source}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: says of no pad that can be simulated ({error})") from error
    return SimulatedConverter(
        pad,
        validate(RigSettings, rig, f"{path}: rig"),
        validate(Contact, contact, f"{path}: contact"),
        size=validate(PadSettings, {**pad.layout.settings, **size}, f"{path}: pad"),
    )
