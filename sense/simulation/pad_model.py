"""The simulated pad: what an ADC reads from each fibre while a probe presses.

The strain of a fibre is its relative stretch by the contact model times how far the probe is down. Four things the
published recording shows come on top: every press is answered a little more or less strongly than the last one at the
same position, the answer creeps (part of it follows slowly), unloading is not the reverse of loading (the fibre
overshoots beyond its rest and comes back within seconds), and the rest itself wanders over minutes. A fibre is a
resistor in a potential divider with a fixed one; an ADC with white noise reads their middle.

Strengths are of the order of that recording: answers up to some 0.2 V on a rest near 2 V that scatter by a sixth of
themselves, overshoot of a fifth, rest wandering by 0.04 V, noise of 1.6 mV."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from padforge.design import Contact, Morphology
from padforge.design.contact import relative_stretch
from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings

SUPPLY_V = 3.3
ADC_STEPS = 4095
GAUGE = 0.4
"""Relative change of a fibre's resistance for its relative stretch at full depth, 5 mm."""
FULL_DEPTH_MM = 5.0
TRAVEL_S = 0.15
"""Time the probe takes from the surface to its depth, and back."""
DELAY_S = (0.08, 0.2)
"""Range of the time from the command to the touch, and to the start of the release."""
CREEP_S = (0.4, 6.0)
"""Time constants of the creeping part of an answer, in equal shares."""
DRIFT_S = 600.0
"""Correlation time of the rest."""
REST_V = (1.7, 2.1)
"""Range of the voltages at rest; the divider is matched to half the supply only roughly."""


@dataclass(frozen=True)
class Cycle:
    """When, within a cycle of `readings` readings at `rate_hz`, the probe is sent down; up it goes at the end."""

    readings: int
    rate_hz: float

    @property
    def down_at(self) -> int:
        """Reading of the cycle at which the probe is sent down."""
        return self.readings // 2

    @property
    def held_at(self) -> int:
        """Reading of the cycle from which on the probe is held down, at the latest its last one."""
        arriving = math.ceil((DELAY_S[1] + TRAVEL_S) * self.rate_hz)
        return min(self.down_at + arriving, self.readings - 1)


def indentation(cycle: Cycle, delays_s: Array) -> Array:
    """How far the probe is down, 0 to 1, in the cycle of each press and the one after, in which it leaves.

    Args:
        delays_s: (Q, 2) from the command to the touch, and from the command to the start of the release.

    Returns:
        (Q, 2 readings).
    """
    times = np.arange(2 * cycle.readings) / cycle.rate_hz
    touch = cycle.down_at / cycle.rate_hz + delays_s[:, :1]
    leave = cycle.readings / cycle.rate_hz + delays_s[:, 1:]
    return np.clip((times - touch) / TRAVEL_S, 0, 1) - np.clip((times - leave) / TRAVEL_S, 0, 1)


def strain(signals: Array, indented: Array) -> Array:
    """(Q, C) signals and (Q, 2 readings) indentation to (Q readings, C) strain; neighbouring cycles add up."""
    readings = indented.shape[1] // 2
    own = signals[:, None, :] * indented[:, :readings, None]
    own[1:] += signals[:-1, None, :] * indented[:-1, readings:, None]
    return own.reshape(-1, signals.shape[1])


class Answer:
    """The part of the strain that shows: creeping, and overshooting as it goes down; may be asked bit by bit.

    Args:
        rate_hz: readings a second. creep: share that follows by `CREEP_S`. hysteresis: overshoot as a share of the
            strain lost. hysteresis_s: time constant of the return from it.
    """

    def __init__(self, rate_hz: float, creep: float, hysteresis: float, hysteresis_s: float) -> None:
        self._creep, self._hysteresis = creep, hysteresis
        self._lags = [Lag(rate_hz * time_constant) for time_constant in CREEP_S]
        self._stay = np.exp(-1 / (rate_hz * hysteresis_s))
        self._last: Array | None = None
        self._overshoot: Array | None = None

    def __call__(self, strained: Array) -> Array:
        """(R, C) strain, going on from what was asked before, to (R, C), settling at it where it stays as it is."""
        shown = (1 - self._creep) * strained
        for lag in self._lags:
            shown = shown + self._creep / len(self._lags) * lag(strained)
        last = strained[:1] if self._last is None else self._last
        earlier = np.concatenate([last, strained[:-1]])
        unloading = np.sign(earlier) * np.maximum(np.abs(earlier) - np.abs(strained), 0)
        before = np.zeros_like(last) if self._overshoot is None else self._overshoot
        over, self._overshoot = lfilter([1.0], [1.0, -self._stay], unloading, axis=0, zi=before)
        self._last = strained[-1:].copy()
        return shown - self._hysteresis * over


class Lag:
    """A first-order lag with a time constant of `steps` rows, starting settled at the first of (R, C) values."""

    def __init__(self, steps: float) -> None:
        self._stay = np.exp(-1 / steps)
        self._state: Array | None = None

    def __call__(self, values: Array) -> Array:
        before = self._stay * values[:1] if self._state is None else self._state
        lagged, self._state = lfilter([1 - self._stay], [1.0, -self._stay], values, axis=0, zi=before)
        return lagged


class Wander:
    """Rests of unit variance, correlated over `DRIFT_S`: an Ornstein-Uhlenbeck process from its own equilibrium."""

    def __init__(self, fibres: int, rate_hz: float, rng: np.random.Generator) -> None:
        self._stay = np.exp(-1 / (rate_hz * DRIFT_S))
        self._rng = rng
        self._state = self._stay * rng.standard_normal((1, fibres))

    def __call__(self, readings: int) -> Array:
        """The next (R, C)."""
        kicks = self._rng.standard_normal((readings, self._state.shape[1])) * np.sqrt(1 - self._stay**2)
        wandered, self._state = lfilter([1.0], [1.0, -self._stay], kicks, axis=0, zi=self._state)
        return wandered


def divider(rest_v: Array, change: Array) -> Array:
    """Voltage over the fixed resistor as the fibre's resistance grows by the share `change`, from `rest_v`."""
    ratio = SUPPLY_V / rest_v - 1  # fibre at rest over fixed resistor
    return SUPPLY_V / (1 + ratio * (1 + change))


def digitised(volts: Array) -> Array:
    """What a 12-bit ADC makes of `volts`: a whole number of steps within its range, in volts."""
    return np.clip(np.rint(volts / SUPPLY_V * ADC_STEPS), 0, ADC_STEPS) * (SUPPLY_V / ADC_STEPS)


def read_pad(
    answers: Array,
    depths_mm: Array,
    cycle: Cycle,
    rig: RigSettings,
    rng: np.random.Generator,
    noise_v: Array | None = None,
) -> Array:
    """What the ADC gives of a plan of presses; as in `LivePad`, a press of half the depth gives half the strain.

    Args:
        answers: (Q, C) relative stretches at full depth; or V, as measured, which is how a held press differs from
            the rest.
        depths_mm: (Q,) how deep the presses are.
        noise_v: (C,) by how much answers in V scatter whatever they are, standard deviation; None for stretches.

    Returns:
        (Q readings, C) V.
    """
    presses, channels = answers.shape
    # the divider draws first, as in `LivePad`: with the same seed fibres rest where they do there
    model = Divider(channels, cycle.rate_hz, rig, rng, linear=noise_v is not None)
    answers = answers * rig.response_scatter.sample_gains((presses, channels), rng)
    if noise_v is not None:
        own_v = np.sqrt(np.maximum(noise_v**2 - reading_noise_v(cycle, rig) ** 2, 0))
        answers = (answers + own_v * rng.standard_normal(answers.shape)) / held_share(cycle, rig)
    indented = indentation(cycle, rng.uniform(*DELAY_S, (presses, 2)))
    return model(strain(depths_mm[:, None] / FULL_DEPTH_MM * answers, indented))


def held_share(cycle: Cycle, rig: RigSettings) -> float:
    """What a press shows while it is held, on average, as a share of what it would settle at."""
    pressed = np.zeros((cycle.readings, 1))
    pressed[cycle.down_at :] = 1.0
    return float(_answer(cycle.rate_hz, rig)(pressed)[cycle.held_at :].mean())


def reading_noise_v(cycle: Cycle, rig: RigSettings) -> float:
    """Standard deviation of a held press minus the rest before it by white noise and drift alone, V."""
    held, rest = np.arange(cycle.held_at, cycle.readings), np.arange(cycle.down_at // 2, cycle.down_at)
    times_s = np.append(held, rest) / cycle.rate_hz
    weights = np.append(np.full(len(held), 1 / len(held)), np.full(len(rest), -1 / len(rest)))
    alike = np.exp(-np.abs(times_s[:, None] - times_s) / DRIFT_S)
    drift, white = weights @ alike @ weights, weights @ weights
    return float(1e-3 * np.sqrt(rig.drift_mv**2 * drift + rig.noise_mv**2 * white))


def _answer(rate_hz: float, rig: RigSettings) -> Answer:
    return Answer(rate_hz, rig.creep, rig.hysteresis, rig.hysteresis_s)


class Divider:
    """The fibres of a simulated pad in their dividers, read by an ADC; may be asked bit by bit.

    Args:
        linear: whether strains are what voltages change by, V, as measured ones are, and not relative to a fibre.
    """

    def __init__(
        self, fibres: int, rate_hz: float, rig: RigSettings, rng: np.random.Generator, linear: bool = False
    ) -> None:
        self._rest_v = rng.uniform(*REST_V, fibres)
        self._answer = _answer(rate_hz, rig)
        self._wander = Wander(fibres, rate_hz, rng)
        self._rig, self._rng, self._linear = rig, rng, linear

    def __call__(self, strained: Array) -> Array:
        """(R, C) strain, relative stretch or V, going on from what was asked before, to (R, C) volts."""
        if not len(strained):
            return strained
        shown = self._answer(strained)
        volts = self._rest_v + shown if self._linear else divider(self._rest_v, GAUGE * shown)
        volts += self._rig.drift_mv * 1e-3 * self._wander(len(volts))
        volts += self._rig.noise_mv * 1e-3 * self._rng.standard_normal(volts.shape)
        return digitised(volts)


class LivePad:
    """A simulated pad that is asked what it gives for where the tip is; one physical model for every simulated rig.

    Args:
        pad: course of the fibres. contact: what a press deforms. rig: strengths of creep, noise and drift.
        rate_hz: at which it is asked. rng: of rests, drift and noise.
    """

    def __init__(
        self, pad: Morphology, contact: Contact, rig: RigSettings, rate_hz: float, rng: np.random.Generator
    ) -> None:
        self._pad, self._contact = pad, contact
        self._divider = Divider(len(pad.knots), rate_hz, rig, rng)
        self._rig, self._rng = rig, rng
        self._known: dict[tuple[float, float], Array] = {}
        self._gains = np.ones(len(pad.knots))
        self._touched = False

    def volts(self, positions_mm: Array, depths_mm: Array) -> Array:
        """(R, C) volts for tips at (R, 2) mm from the pad's centre, (R,) mm below its surface (above: less than 0)."""
        strained = np.zeros((len(positions_mm), len(self._pad.knots)))
        for row, touched in enumerate(depths_mm > 0):
            if touched and not self._touched:
                self._gains = self._rig.response_scatter.sample_gains((1, len(self._gains)), self._rng)[0]
            self._touched = bool(touched)
            if touched:
                strained[row] = depths_mm[row] / FULL_DEPTH_MM * self._gains * self._stretch(positions_mm[row])
        return self._divider(strained)

    def _stretch(self, place_mm: Array) -> Array:
        """(C,) of a press at full depth; the tip of an arm at rest stays within hundredths of a millimetre."""
        x, y = np.round(place_mm, 2).tolist()
        if (x, y) not in self._known:
            self._known = {(x, y): relative_stretch(self._pad, self._pad.to_grid([[x, y]]), self._contact)[0]}
        return self._known[x, y]
