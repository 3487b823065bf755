"""A board without hardware: a simulated pad that a finger presses at random positions, in real time."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from padforge.common.files import read_json
from padforge.common.validation import InputError
from padforge.design import Contact, Morphology
from padforge.design.settings import PadSettings
from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import make_plan
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig import clock
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.rig.streams import RECORDED
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import SUPPLY_V, TRAVEL_S, LivePad
from padforge.sense.simulation.simulated_recording import sample_positions


class SimulatedBoard:
    """A board that samples a simulated pad at `[rig] rate_hz`; implements `Board`.

    The pad, with the baselines of its fibres, is the one that `simulate` makes of the same arguments. Presses have the
    same timing, other positions, and the depths of `[rig]` in turn. `pad_settings` has the sensed area and keep-outs.
    """

    def __init__(
        self, pad: Morphology, rig: RigSettings, contact: Contact, pad_settings: PadSettings | None = None
    ) -> None:
        rig = rig.for_contact(contact)
        rng = np.random.default_rng(rig.seed)
        if rig.plan_file is None:
            make_plan(pad, rig, rng, pad_settings)  # `simulate`, too, draws the plan before the pad
        self._model = LivePad(pad, contact, rig, rig.rate_hz, rng)
        self._pad, self._rig, self._pad_settings = pad, rig, pad_settings
        self._depths_mm = rig.press_depths_mm
        self._position_rng = rng.spawn(1)[0]
        self._start_s: float | None = None
        self._n_samples = 0
        self._press, self._position_mm = -1, np.zeros(2)

    def connect(self) -> Mapping[str, Any]:
        """Start sampling; see `Board`."""
        self._model.prepare()  # slow, so done before real time begins
        self._start_s, self._n_samples = clock.now(), 0
        fibres = len(self._pad.knots)
        identity = {"name": "simulated", "channels": fibres, "inputs": list(range(fibres))}
        return {**identity, "rate_hz": self._rig.rate_hz, "supply_v": SUPPLY_V}

    def read(self) -> BoardSamples:
        """Return all samples since the last call; see `Board`. Raises RigFault("refused") before `connect`."""
        if self._start_s is None:
            raise RigFault("refused", "the simulated rig is not connected")
        count = math.floor((clock.now() - self._start_s) * self._rig.rate_hz)
        elapsed_s = np.arange(self._n_samples + 1, count + 1) / self._rig.rate_hz
        self._n_samples = count
        touches = [self._touch(time_s) for time_s in elapsed_s.tolist()]
        positions_mm = np.array([position for position, _ in touches]).reshape(-1, 2)
        volts = self._model.volts(positions_mm, np.array([depth for _, depth in touches]))
        return BoardSamples(self._start_s + elapsed_s, volts, np.zeros(len(elapsed_s), np.int64))

    def close(self) -> None:
        """Do nothing; see `Board`."""

    def _touch(self, time_s: float) -> tuple[Array, float]:
        """Return the finger's position and depth, mm; it presses in the second half of every cycle."""
        # Not twice `half_cycle_s`, which is of a real board: a reading is the average of a whole number of its samples.
        cycle_s = self._rig.readings_per_press / self._rig.rate_hz
        press, elapsed_s = divmod(time_s, cycle_s)
        if press > self._press:
            self._press = press
            self._position_mm = sample_positions(self._pad, 1, self._position_rng, self._pad_settings)[0]
        relative_depth = min((elapsed_s - cycle_s / 2) / TRAVEL_S, 1.0, (cycle_s - elapsed_s) / TRAVEL_S)
        return self._position_mm, self._depths_mm[int(press) % len(self._depths_mm)] * max(relative_depth, 0.0)


def simulated_board_of(model: Path) -> SimulatedBoard:
    """Return the simulated pad on whose recording the model in a folder was trained; InputError if there is none."""
    path = model / RECORDED / START
    if not path.is_file():
        raise InputError(f"{path}: is missing, and the pad to simulate is unknown; name a model of `padforge run`")
    source = read_json(path, FORMAT)["source"]
    if source.get("kind") != "simulated":
        raise InputError(f"{path}: is not of a simulated pad, as --rig simulated needs; --replay shows a recording")
    if "twin" in source:
        raise InputError(f"{path}: is of a pad simulated by its twin, which cannot be live; --replay shows a recording")
    try:
        pad = Morphology.from_dict(source["morphology"])
        rig = RigSettings(**source["rig"] | {"channels": ()})  # a simulated pad is not wired to inputs
        pressed = {key: source[key] for key in ("sensed_mm", "keep_out_mm") if key in source}
        return SimulatedBoard(pad, rig, Contact(**source["contact"]), PadSettings(**pad.layout.settings | pressed))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: describes no pad that can be simulated ({error})") from error
