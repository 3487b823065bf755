"""A person without a body: presses a simulated pad where a page or a terminal asks for it, as well as people do."""

import math
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.design import Contact, Morphology, signals
from padforge.sense.arrays import Array
from padforge.sense.rig.boards.due import Arduino
from padforge.sense.rig.devices import Board
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import TRAVEL_S, LivePad
from padforge.sense.virtual.boards import EmulatedBoard

SCATTER_MM = 1.5
"""Standard deviation, each way, of where a press goes."""
DEPTHS = (0.7, 1.1)
"""Range of depths, shares of `depth_mm`."""
LATE_S = (0.3, 0.7)
"""Range of the time from being asked to the touch; a lift follows in half of it."""
MISHAPS = ("short", "double", "light", "slide")
"""A press is let go at once, or followed by a second tap, or hardly felt, or slides away."""
SHORT_S, AGAIN_S, LIGHT, SLIDE_MM = 0.3, 0.25, 0.04, 12.0
PATIENCE_S = 3.0
"""After so long a press that nobody noticed is given up."""


@dataclass
class FingerStroke:
    """A press: where, how deep, mm, and from when to when the finger is down, s; `up_s` is inf while nobody knows."""

    kind: str
    place_mm: Array
    depth_mm: float
    down_s: float
    up_s: float = math.inf
    slide_mm: float = 0.0

    def at(self, time_s: float) -> tuple[Array, float]:
        """Place and depth at a time."""
        since_s, until_s = time_s - self.down_s, self.up_s + TRAVEL_S - time_s
        slid = np.array([min(max(since_s, 0.0), 1.0) * self.slide_mm, 0.0])
        return self.place_mm + slid, self.depth_mm * min(max(min(since_s, until_s) / TRAVEL_S, 0.0), 1.0)


class Finger:
    """A finger that looks at what is shown (`look`) and moves as the samples go by (`volts`).

    Attributes:
        strokes: all that it has done.
    """

    def __init__(
        self,
        pad: Morphology,
        contact: Contact,
        rig: RigSettings,
        rate_hz: float,
        *,
        scatter_mm: float = SCATTER_MM,
        mishaps: float = 0.05,
    ) -> None:
        """Get ready over a pad that is sampled at `rate_hz`.

        Args:
            scatter_mm: see `SCATTER_MM`. mishaps: share of presses that come to one of `MISHAPS`.
        """
        rng = np.random.default_rng(rig.seed)
        self._model = LivePad(pad, contact, rig, rate_hz, rng)
        self._rng, self._depth_mm = rng.spawn(1)[0], rig.depth_mm
        self._scatter_mm, self._mishaps = scatter_mm, mishaps
        self._view: Mapping[str, Any] = {"phase": "settle"}
        self._now_s = -math.inf
        self.strokes: list[FingerStroke] = []

    def look(self, view: Mapping[str, Any]) -> None:
        """See what is shown: its "phase" and "target", [x, y] mm."""
        self._view = view

    def said(self) -> list[str]:
        """What it says to what is shown: that it touches nothing, where it has long been told to lift."""
        waits = self._view["phase"] == "lift" and bool(self.strokes)
        return ["free"] if waits and self._now_s > self.strokes[-1].up_s + PATIENCE_S else []

    def volts(self, times_s: Array) -> Array:
        """(n, C) volts at (n,) ascending times, s, later than those before."""
        places, depths = zip(*map(self._touch, times_s.tolist()), strict=True) if len(times_s) else ((), ())
        return self._model.volts(np.reshape(places, (-1, 2)), np.array(depths, dtype=np.float64))

    def _touch(self, at_s: float) -> tuple[Array, float]:
        stroke, self._now_s = self.strokes[-1] if self.strokes else None, at_s
        if stroke is None or at_s > stroke.up_s + TRAVEL_S:
            stroke = self._next(stroke, at_s)
        if stroke is None:
            return np.zeros(2), 0.0
        if stroke.up_s == math.inf:
            if self._view["phase"] == "lift":
                stroke.up_s = at_s + self._rng.uniform(*LATE_S) / 2
            elif at_s > stroke.down_s + PATIENCE_S and self._view["phase"] == "press":
                stroke.up_s = at_s
        return stroke.at(at_s)

    def _next(self, last: FingerStroke | None, at_s: float) -> FingerStroke | None:
        """The stroke that is begun now, if any is."""
        if last is not None and last.kind == "double":
            again_s = at_s + AGAIN_S
            self.strokes.append(FingerStroke("echo", last.place_mm, last.depth_mm, again_s, again_s + SHORT_S))
            return self.strokes[-1]
        if self._view["phase"] != "press":
            return None
        kind = str(self._rng.choice(MISHAPS)) if self._rng.random() < self._mishaps else "press"
        place_mm = np.array(self._view["target"]) + self._scatter_mm * self._rng.standard_normal(2)
        depth_mm = self._depth_mm * self._rng.uniform(*DEPTHS)
        stroke = FingerStroke(kind, place_mm, depth_mm, at_s + self._rng.uniform(*LATE_S))
        if kind in ("short", "light"):
            stroke.up_s = stroke.down_s + SHORT_S
        if kind == "light":
            stroke.depth_mm *= LIGHT
        if kind == "slide":
            stroke.slide_mm = -math.copysign(SLIDE_MM, place_mm[0])
        self.strokes.append(stroke)
        return stroke


@contextmanager
def pressed_by_finger(pad: Morphology, contact: Contact, rig: RigSettings) -> Iterator[tuple[Board, Finger]]:
    """The driver of an emulated board, not yet connected, over a simulated pad, and the finger that presses it."""
    finger = Finger(pad, contact, rig, rig.board_rate_hz)
    signals(pad, pad.to_grid([[0.0, 0.0]]), contact)  # compiled before the board has to keep up
    with EmulatedBoard(finger.volts) as board:
        emulated = rig.model_copy(update={"port": board.port})
        with closing(Arduino.of(emulated, range(len(pad.knots)))) as converter:
            yield converter, finger
