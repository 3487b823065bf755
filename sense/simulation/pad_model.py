"""Physical model of a simulated pad: what an ADC reads from each fibre while a probe presses.

The response of a fibre is the change of its resistance by the contact model. Effects of
the published recording, whose sizes are the defaults of `[rig]`, are added: the response scatters about that of the
position, creeps, and has hysteresis (unloaded, a fibre overshoots its rest and comes back within seconds); the rest
drifts over minutes. An ADC with white noise reads the middle of the fibre and a fixed resistor.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from padforge.design import Contact, Morphology
from padforge.design.contact import DEPTH_STEPS, indented_signals, relative_stretch
from padforge.design.paths.curves import lengths
from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings

SUPPLY_V = 3.3
ADC_STEPS = 4095
GAUGE_FACTOR = 0.65  # relative change of a fibre's resistance per strain in a layer
WEIGHT_GAUGE_FACTOR = 0.4  # and per relative stretch of a contact with weights about 1, pressed FULL_DEPTH_MM deep
FULL_DEPTH_MM = 5.0
TRAVEL_S = 0.15  # time that the probe takes from the surface to its depth, and back
DELAY_S = (0.08, 0.2)  # range of the time from the command to the touch, and to the start of the release
CREEP_S = (0.4, 6.0)  # time constants of creep, in equal shares
DRIFT_S = 600.0  # correlation time of the drift
REST_V = (1.7, 2.1)  # range of the voltages at rest; the divider is matched to half the supply only roughly


@dataclass(frozen=True)
class Cycle:
    """Cycle of a press, in readings: the probe is sent down in its middle, and up at its end."""

    readings: int
    rate_hz: float

    @property
    def down_index(self) -> int:
        """Reading of the cycle at which the probe is sent down."""
        return self.readings // 2

    @property
    def held_index(self) -> int:
        """Reading of the cycle from which on the probe is at its depth, at the latest the last one."""
        return min(self.down_index + math.ceil((DELAY_S[1] + TRAVEL_S) * self.rate_hz), self.readings - 1)


def resistance_changes(pad: Morphology, positions_mm: Array, depths_mm: Array, contact: Contact) -> Array:
    """Compute the relative changes of resistance (Q, C) by presses (Q, 2) of depths (Q,).

    A layer is pressed as deep, other contacts, which know no depth, respond in proportion to it.
    """
    presses = pad.to_grid(positions_mm)
    if contact.model != "layer":
        return WEIGHT_GAUGE_FACTOR / FULL_DEPTH_MM * depths_mm[:, None] * relative_stretch(pad, presses, contact)

    def pressed(depth_mm: float) -> Contact:
        return Contact(**contact.model_dump() | {"depth_mm": depth_mm})

    depths = np.unique(depths_mm).tolist()
    if len(depths) > DEPTH_STEPS:
        return GAUGE_FACTOR * indented_signals(pad, presses, depths_mm, pressed(depths[-1])) / lengths(pad)
    changes = np.empty((len(presses), len(pad.knots)))
    for depth_mm in depths:
        rows = depths_mm == depth_mm
        changes[rows] = GAUGE_FACTOR * relative_stretch(pad, presses[rows], pressed(depth_mm))
    return changes


def relative_depths(cycle: Cycle, delays_s: Array) -> Array:
    """Compute the relative depth (Q, 2 readings), 0 to 1, in a press's cycle and the next, from `delays_s` (Q, 2)."""
    times_s = np.arange(2 * cycle.readings) / cycle.rate_hz
    touch_s = cycle.down_index / cycle.rate_hz + delays_s[:, :1]
    release_s = cycle.readings / cycle.rate_hz + delays_s[:, 1:]
    return np.clip((times_s - touch_s) / TRAVEL_S, 0, 1) - np.clip((times_s - release_s) / TRAVEL_S, 0, 1)


def superpose_strain(responses: Array, depths: Array) -> Array:
    """Superpose the strain (Q readings, C) of presses by their responses (Q, C) and relative depths (Q, 2 readings)."""
    readings = depths.shape[1] // 2
    strain = responses[:, None, :] * depths[:, :readings, None]
    strain[1:] += responses[:-1, None, :] * depths[:-1, readings:, None]
    return strain.reshape(-1, responses.shape[1])


class CreepHysteresis:
    """Creep of a share of the response, and hysteresis: an overshoot by a share of the strain lost, which decays."""

    def __init__(self, rate_hz: float, rig: RigSettings) -> None:
        self._creep, self._hysteresis = rig.creep, rig.hysteresis
        self._creep_decays = [np.exp(-1 / (rate_hz * time_constant)) for time_constant in CREEP_S]
        self._decay = np.exp(-1 / (rate_hz * rig.hysteresis_s))
        self._last: Array | None = None  # strain, and the states of the filters after it
        self._lags: list[Array] = []
        self._overshoot = np.zeros(0)

    def __call__(self, strain: Array) -> Array:
        """Compute the visible part of further strain (R, C), which settles at the strain."""
        if self._last is None:  # settled at the first strain
            self._last, self._overshoot = strain[:1], np.zeros_like(strain[:1])
            self._lags = [decay * strain[:1] for decay in self._creep_decays]
        visible = (1 - self._creep) * strain
        for i, decay in enumerate(self._creep_decays):
            lagged, self._lags[i] = lfilter([1 - decay], [1.0, -decay], strain, axis=0, zi=self._lags[i])
            visible = visible + self._creep / len(self._lags) * lagged
        previous = np.concatenate([self._last, strain[:-1]])
        unloading = np.sign(previous) * np.maximum(np.abs(previous) - np.abs(strain), 0)
        overshoot, self._overshoot = lfilter([1.0], [1.0, -self._decay], unloading, axis=0, zi=self._overshoot)
        self._last = strain[-1:].copy()
        return visible - self._hysteresis * overshoot


class Drift:
    """Drift of unit variance with correlation time `DRIFT_S`: a stationary Ornstein-Uhlenbeck process."""

    def __init__(self, fibres: int, rate_hz: float, rng: np.random.Generator) -> None:
        self._decay = np.exp(-1 / (rate_hz * DRIFT_S))
        self._rng = rng
        self._state = self._decay * rng.standard_normal((1, fibres))

    def __call__(self, readings: int) -> Array:
        """Sample the next values; shape (R, C)."""
        steps = self._rng.standard_normal((readings, self._state.shape[1])) * np.sqrt(1 - self._decay**2)
        drift, self._state = lfilter([1.0], [1.0, -self._decay], steps, axis=0, zi=self._state)
        return drift


def divider_voltage(rest_v: Array, change: Array) -> Array:
    """Compute the voltage over the fixed resistor when the fibre's resistance has grown by the share `change`."""
    ratio = SUPPLY_V / rest_v - 1  # fibre at rest over fixed resistor
    return SUPPLY_V / (1 + ratio * (1 + change))


def quantize(volts: Array) -> Array:
    """Quantize voltages as a 12-bit ADC does: whole steps within its range, V."""
    return np.clip(np.rint(volts / SUPPLY_V * ADC_STEPS), 0, ADC_STEPS) * (SUPPLY_V / ADC_STEPS)


class Divider:
    """Fibres in their dividers, read by an ADC; strain is a relative change of resistance, or in V if `linear`."""

    def __init__(
        self, fibres: int, rate_hz: float, rig: RigSettings, rng: np.random.Generator, linear: bool = False
    ) -> None:
        self._rest_v = rng.uniform(*REST_V, fibres)
        self._creep_hysteresis = CreepHysteresis(rate_hz, rig)
        self._drift = Drift(fibres, rate_hz, rng)
        self._rig, self._rng, self._linear = rig, rng, linear

    def __call__(self, strain: Array) -> Array:
        """Read the voltages of further strain (R, C)."""
        if not len(strain):
            return strain
        visible = self._creep_hysteresis(strain)
        volts = self._rest_v + visible if self._linear else divider_voltage(self._rest_v, visible)
        volts += self._rig.drift_mv * 1e-3 * self._drift(len(volts))
        volts += self._rig.noise_mv * 1e-3 * self._rng.standard_normal(volts.shape)
        return quantize(volts)


def simulate_readings(
    responses: Array,
    cycle: Cycle,
    rig: RigSettings,
    rng: np.random.Generator,
    noise_v: Array | None = None,
) -> Array:
    """Simulate the readings (Q readings, C), V, of presses.

    Responses (Q, C) are relative changes of resistance; or V, as measured (a held press minus the rest), with the
    standard deviation `noise_v` (C,) that does not depend on them.
    """
    presses, channels = responses.shape
    # The divider draws first, as in `LivePad`: with the same seed fibres have the same rests there.
    divider = Divider(channels, cycle.rate_hz, rig, rng, linear=noise_v is not None)
    responses = responses * rig.response_scatter.sample_gains((presses, channels), rng)
    if noise_v is not None:
        press_noise_v = np.sqrt(np.maximum(noise_v**2 - _reading_noise_v(cycle, rig) ** 2, 0))
        responses = (responses + press_noise_v * rng.standard_normal(responses.shape)) / _held_share(cycle, rig)
    depths = relative_depths(cycle, rng.uniform(*DELAY_S, (presses, 2)))
    return divider(superpose_strain(responses, depths))


def _held_share(cycle: Cycle, rig: RigSettings) -> float:
    """Return the mean response while a press is held, as a share of what it would settle at."""
    pressed = np.zeros((cycle.readings, 1))
    pressed[cycle.down_index :] = 1.0
    return float(CreepHysteresis(cycle.rate_hz, rig)(pressed)[cycle.held_index :].mean())


def _reading_noise_v(cycle: Cycle, rig: RigSettings) -> float:
    """Return the standard deviation of a held press minus the rest before it, by white noise and drift alone, V."""
    held = np.arange(cycle.held_index, cycle.readings)
    rest = np.arange(cycle.down_index // 2, cycle.down_index)
    times_s = np.append(held, rest) / cycle.rate_hz
    weights = np.append(np.full(len(held), 1 / len(held)), np.full(len(rest), -1 / len(rest)))
    correlation = np.exp(-np.abs(times_s[:, None] - times_s) / DRIFT_S)
    drift, white = weights @ correlation @ weights, weights @ weights
    return float(1e-3 * np.sqrt(rig.drift_mv**2 * drift + rig.noise_mv**2 * white))


class LivePad:
    """A simulated pad under a moving tip; one physical model for every virtual rig."""

    def __init__(
        self, pad: Morphology, contact: Contact, rig: RigSettings, rate_hz: float, rng: np.random.Generator
    ) -> None:
        self._pad, self._contact = pad, contact
        self._divider = Divider(len(pad.knots), rate_hz, rig, rng)
        self._rig, self._rng = rig, rng
        self._depth_mm = max(rig.depths_mm, default=rig.depth_mm)
        self._cache: dict[tuple[float, float], Array] = {}
        self._gains = np.ones(len(pad.knots))
        self._is_touched = False

    def prepare(self) -> None:
        """Compile and solve what the first press would wait for."""
        self._response(np.zeros(2))

    def volts(self, positions_mm: Array, depths_mm: Array) -> Array:
        """Return the readings (R, C), V, at further positions (R, 2) of the tip, from the pad's centre.

        Depths (R,) are below the surface, negative above.
        """
        strain = np.zeros((len(positions_mm), len(self._pad.knots)))
        for row, is_touched in enumerate(depths_mm > 0):
            if is_touched and not self._is_touched:
                self._gains = self._rig.response_scatter.sample_gains((1, len(self._gains)), self._rng)[0]
            self._is_touched = bool(is_touched)
            if is_touched:
                strain[row] = depths_mm[row] / self._depth_mm * self._gains * self._response(positions_mm[row])
        return self._divider(strain)

    def _response(self, position_mm: Array) -> Array:
        """(C,) of the deepest press; the tip of an arm at rest stays within hundredths of a millimetre."""
        x, y = np.round(position_mm, 2).tolist()
        if (x, y) not in self._cache:
            position, depth = np.array([[x, y]]), np.array([self._depth_mm])
            self._cache = {(x, y): resistance_changes(self._pad, position, depth, self._contact)[0]}
        return self._cache[x, y]
