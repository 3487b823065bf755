"""The simulated pad: what an ADC reads from each fibre while a probe presses.

The strain of a fibre is its signal by the contact model times how far the probe is down. Three things the published
recording shows come on top: the answer creeps (part of it follows slowly), unloading is not the reverse of loading
(the fibre overshoots beyond its rest and comes back within seconds), and the rest itself wanders over minutes. A fibre
is a resistor in a potential divider with a fixed one; an ADC with white noise reads their middle.

Strengths are of the order of that recording: answers up to some 0.2 V on a rest near 2 V, overshoot of a fifth, rest
wandering by 0.04 V, noise of 1.6 mV.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from ..settings import Rig

Array = NDArray[np.float64]

SUPPLY_V = 3.3
ADC_STEPS = 4095
GAUGE = 0.08
"""Relative change of a fibre's resistance per grid unit of signal at full depth, 5 mm."""
FULL_DEPTH_MM = 5.0
TRAVEL_S = 0.15
"""Time the probe takes from the surface to its depth, and back."""
DELAY_S = (0.08, 0.2)
"""Range of the time from the command to the touch, and to the start of the release."""
CREEP_S = (0.4, 6.0)
"""Time constants of the creeping part of an answer, in equal shares."""
OVERSHOOT_S = 2.5
"""Time constant of the return from the overshoot after unloading."""
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


def answer(strained: Array, rate_hz: float, creep: float, hysteresis: float) -> Array:
    """The part of the strain that shows: creeping, and overshooting as it goes down.

    Args:
        strained: (R, C). creep: share that follows by `CREEP_S`. hysteresis: overshoot as a share of the strain lost.

    Returns:
        (R, C), settling at `strained` where that stays as it is.
    """
    shown = (1 - creep) * strained
    for time_constant in CREEP_S:
        shown = shown + creep / len(CREEP_S) * follow(strained, rate_hz * time_constant)
    unloading = np.maximum(-np.diff(strained, axis=0, prepend=strained[:1]), 0)
    stay = np.exp(-1 / (rate_hz * OVERSHOOT_S))
    return shown - hysteresis * np.asarray(lfilter([1.0], [1.0, -stay], unloading, axis=0))


def follow(values: Array, steps: float) -> Array:
    """A first-order lag with a time constant of `steps` rows, starting settled at the first of (R, C) `values`."""
    stay = np.exp(-1 / steps)
    settled, _ = lfilter([1 - stay], [1.0, -stay], values, axis=0, zi=stay * values[:1])
    return np.asarray(settled)


def wander(readings: int, fibres: int, rate_hz: float, rng: np.random.Generator) -> Array:
    """(R, C) of unit variance, correlated over `DRIFT_S`: an Ornstein-Uhlenbeck process from its own equilibrium."""
    stay = np.exp(-1 / (rate_hz * DRIFT_S))
    kicks = rng.standard_normal((readings, fibres)) * np.sqrt(1 - stay**2)
    kicks[0] = rng.standard_normal(fibres)
    return np.asarray(lfilter([1.0], [1.0, -stay], kicks, axis=0))


def divider(rest_v: Array, change: Array) -> Array:
    """Voltage over the fixed resistor as the fibre's resistance grows by the share `change`, from `rest_v`."""
    ratio = SUPPLY_V / rest_v - 1  # fibre at rest over fixed resistor
    return SUPPLY_V / (1 + ratio * (1 + change))


def digitised(volts: Array) -> Array:
    """What a 12-bit ADC makes of `volts`: a whole number of steps within its range, in volts."""
    return np.clip(np.rint(volts / SUPPLY_V * ADC_STEPS), 0, ADC_STEPS) * (SUPPLY_V / ADC_STEPS)


def read_pad(signals: Array, cycle: Cycle, rig: Rig, rng: np.random.Generator) -> Array:
    """(Q, C) signals of a plan of presses to (Q readings, C) volts as the ADC gives them."""
    presses, fibres = signals.shape
    rest_v = rng.uniform(*REST_V, fibres)
    indented = indentation(cycle, rng.uniform(*DELAY_S, (presses, 2)))
    shown = answer(strain(signals, indented), cycle.rate_hz, rig.creep, rig.hysteresis)
    volts = divider(rest_v, GAUGE * rig.depth_mm / FULL_DEPTH_MM * shown)
    volts += rig.drift_mv * 1e-3 * wander(len(volts), fibres, cycle.rate_hz, rng)
    volts += rig.noise_mv * 1e-3 * rng.standard_normal(volts.shape)
    return digitised(volts)
