"""An emulated finger that presses a simulated pad where a page or a terminal asks for it, and errs as people do."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.design import Contact, Morphology
from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import TRAVEL_S, LivePad

SCATTER_MM = 1.5  # standard deviation of the position of a press, in x and in y
DEPTHS = (0.7, 1.1)  # range of depths, relative to `depth_mm`
REACTION_S = (0.3, 0.7)  # range of the time from the request to the touch; a lift follows in half of it
MISHAPS = ("short", "double", "light", "slide")
"""A press is let go at once, or followed by a second tap, or hardly felt, or slides away."""
SHORT_S, AGAIN_S, LIGHT, SLIDE_MM = 0.3, 0.25, 0.04, 12.0
PATIENCE_S = 3.0  # time after which a press that was not detected is given up


@dataclass
class FingerStroke:
    kind: str  # "press", one of `MISHAPS`, or "echo", the second tap
    position_mm: Array  # of the touch; shape (2,)
    depth_mm: float  # when it is down
    down_s: float  # time of the touch
    up_s: float = math.inf  # time of the lift; inf while it is unknown
    slide_mm: float = 0.0  # how far it slides along x within a second

    def contact(self, time_s: float) -> tuple[Array, float]:
        since_s, until_s = time_s - self.down_s, self.up_s + TRAVEL_S - time_s
        slide_mm = np.array([min(max(since_s, 0.0), 1.0) * self.slide_mm, 0.0])
        share = min(max(min(since_s, until_s) / TRAVEL_S, 0.0), 1.0)
        return self.position_mm + slide_mm, self.depth_mm * share


class Finger:
    """A finger that looks at what is displayed (`look`) and moves as the samples go by (`volts`)."""

    def __init__(
        self, pad: Morphology, contact: Contact, rig: RigSettings, rate_hz: float, mishaps: float = 0.05
    ) -> None:
        """Hold the finger over a pad; `mishaps` is the share of presses that become one of `MISHAPS`."""
        rig = rig.for_contact(contact)
        rng = np.random.default_rng(rig.seed)
        self._model = LivePad(pad, contact, rig, rate_hz, rng)
        self._model.prepare()  # before the board has to keep up
        self._rng, self._depth_mm = rng.spawn(1)[0], rig.press_depths_mm[0]
        self._mishaps = mishaps
        self._view: Mapping[str, Any] = {"phase": "settle"}
        self._now_s = -math.inf
        self.strokes: list[FingerStroke] = []  # all that it has made

    def look(self, view: Mapping[str, Any]) -> None:
        """See what is displayed: its "phase" and "target", [x, y] mm."""
        self._view = view

    def commands(self) -> list[str]:
        """Return its commands: that the pad is free, if it has long been asked to lift."""
        waits = self._view["phase"] == "lift" and bool(self.strokes)
        return ["free"] if waits and self._now_s > self.strokes[-1].up_s + PATIENCE_S else []

    def volts(self, times_s: Array) -> Array:
        """Return the (n, C) readings at (n,) ascending times, later than those before."""
        positions, depths = zip(*map(self._touch, times_s.tolist()), strict=True) if len(times_s) else ((), ())
        return self._model.volts(np.reshape(positions, (-1, 2)), np.array(depths, dtype=np.float64))

    def _touch(self, time_s: float) -> tuple[Array, float]:
        stroke, self._now_s = self.strokes[-1] if self.strokes else None, time_s
        if stroke is None or time_s > stroke.up_s + TRAVEL_S:
            stroke = self._start_stroke(stroke, time_s)
        if stroke is None:
            return np.zeros(2), 0.0
        if stroke.up_s == math.inf:
            if self._view["phase"] == "lift":
                stroke.up_s = time_s + self._rng.uniform(*REACTION_S) / 2
            elif time_s > stroke.down_s + PATIENCE_S and self._view["phase"] == "press":
                stroke.up_s = time_s
        return stroke.contact(time_s)

    def _start_stroke(self, previous: FingerStroke | None, time_s: float) -> FingerStroke | None:
        if previous is not None and previous.kind == "double":
            down_s = time_s + AGAIN_S
            echo = FingerStroke("echo", previous.position_mm, previous.depth_mm, down_s, down_s + SHORT_S)
            self.strokes.append(echo)
            return echo
        if self._view["phase"] != "press":
            return None
        kind = str(self._rng.choice(MISHAPS)) if self._rng.random() < self._mishaps else "press"
        position_mm = np.array(self._view["target"]) + SCATTER_MM * self._rng.standard_normal(2)
        depth_mm = self._depth_mm * self._rng.uniform(*DEPTHS)
        stroke = FingerStroke(kind, position_mm, depth_mm, time_s + self._rng.uniform(*REACTION_S))
        if kind in ("short", "light"):
            stroke.up_s = stroke.down_s + SHORT_S
        if kind == "light":
            stroke.depth_mm *= LIGHT
        if kind == "slide":
            stroke.slide_mm = -math.copysign(SLIDE_MM, position_mm[0])
        self.strokes.append(stroke)
        return stroke
