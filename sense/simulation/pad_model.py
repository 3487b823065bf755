"""Physical model of a simulated pad: what an ADC reads from each fibre while a probe presses.

The response of a fibre is the change of its resistance by the contact model. Effects of a built pad are added; their
sizes in the published recording are the defaults of `[rig]`. Responses scatter from press to press, follow the probe
with a lag, and creep. They have hysteresis: after a release a fibre overshoots its rest, and recovers within seconds,
or when it is pressed there again. The rest drifts over minutes. An ADC with white noise reads the voltage between the
fibre and a fixed resistor.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from padforge.design import Contact, Morphology
from padforge.design.contact import depth_terms
from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.built_pad import BuiltPad, PressParts, build_pad, press_contacts

SUPPLY_V, ADC_STEPS = 3.3, 2**12 - 1  # supply of the simulated board, and steps of its converter
GAUGE_FACTOR = 0.65  # relative change of a fibre's resistance per strain in a layer
WEIGHT_GAUGE_FACTOR = 0.4  # the same per relative stretch by other contacts, whose weights are about 1, at full depth
FULL_DEPTH_MM = 5.0  # depth at which a contact without depth, or a twin, responds in full
TRAVEL_S = 0.1  # time that the probe takes from the surface to its depth, and back
DELAY_S = (0.04, 0.22)  # range of the time from the command to the touch
RELEASE_S = (0.0, 0.06)  # range of the time from the command to the start of the release
ONSET_S = 0.15  # time constant of the change from the onset response to the held one
CREEP_S = 1.0  # time constant of creep
DRIFT_S = 600.0  # correlation time of the drift
SURFACE_MM, SURFACE_WAVES = 10.0, 8  # length over which the height of a pad changes, and number of waves that add up
MAX_LAG = 32  # maximum number of earlier presses whose residues count
RETURNED = 0.4  # fraction of a removed residue that returns when the press ends
REST_V = (1.7, 2.1)  # range of the voltages at rest, which are half of the supply only roughly


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


def resistance_changes(
    pad: BuiltPad, positions_mm: Array, depths_mm: Array, contact: Contact, rig: RigSettings
) -> PressParts[Array]:
    """Compute the relative changes of resistance (Q, C) by presses (Q, 2) of depths (Q,).

    A layer is solved for each depth; the response of other contacts, which have no depth, is proportional to it.
    """
    changes = np.zeros((4, len(positions_mm), len(pad.paths.knots)))
    if contact.model == "layer":
        deepest = Contact(**contact.model_dump() | {"depth_mm": float(depths_mm.max(initial=1e-3))})
        for rows, weight, pressed in depth_terms(depths_mm, deepest):
            stretch = pad.stretch(positions_mm[rows], press_contacts(pressed, rig))
            changes[:, rows] += GAUGE_FACTOR * weight[:, None] * np.stack(stretch)
    else:
        stretch = pad.stretch(positions_mm, press_contacts(contact, rig))
        changes += WEIGHT_GAUGE_FACTOR / FULL_DEPTH_MM * depths_mm[:, None] * np.stack(stretch)
    held, onset, creep, after = changes
    return PressParts(held, onset, rig.creep * creep, rig.hysteresis * after)


def replaced_residues(
    positions_mm: Array, touch_s: Array, release_s: Array, residues: Array, held: Array, rig: RigSettings
) -> Array:
    """Compute the residues (Q, C) of earlier presses that each of successive presses removes.

    After a release the surface stays indented for a while. If the pad is pressed there again, the probe fills the dent:
    the fibres lose their residue and respond by as much more. When the press ends, a part of the dent returns.
    At distance d a press removes the fraction `memory exp(-d^2 / 2 memory_mm^2)` of what remains of a residue. The
    effect on a fibre is proportional to the geometric mean of that residue and of the response to the press itself.
    Presses at positions (Q, 2) begin and end at times (Q,); residues at their end and held responses are (Q, C).
    """
    replaced, remaining = np.zeros_like(residues), np.ones(len(residues))
    for q in range(1, len(residues) if rig.memory else 0):
        recent = slice(max(q - MAX_LAG, 0), q)
        squares = ((positions_mm[recent] - positions_mm[q]) ** 2).sum(axis=1)
        replaced_share = rig.memory * np.exp(squares / (-2 * rig.memory_mm**2))
        decayed = np.exp((release_s[recent] - touch_s[q]) / rig.hysteresis_s)
        both = np.sqrt(np.maximum(residues[recent] * held[q], 0))
        replaced[q] = np.sign(held[q]) * ((remaining[recent] * replaced_share * decayed) @ both)
        remaining[recent] *= 1 - (1 - RETURNED) * replaced_share
    return replaced


class Gains:
    """Random factors on the responses of successive presses: scatter of each press, times slow wander."""

    def __init__(self, interval_s: float, channels: int, rig: RigSettings, rng: np.random.Generator) -> None:
        self._channels, self._rig, self._rng = channels, rig, rng
        self._wander = Drift(channels, 1 / interval_s, rng)

    def __call__(self, presses: int) -> Array:
        """Sample the factors (Q, C) of the next presses."""
        scatter = self._rig.response_scatter.sample_gains((presses, self._channels), self._rng)
        return scatter * (1 + self._rig.gain_wander * self._wander(presses))


def sample_delays(positions_mm: Array, rig: RigSettings, rng: np.random.Generator) -> Array:
    """Sample the times (Q, 2), s, from the commands to touch and to release; an uneven surface changes the touch."""
    modes = positions_mm @ (rng.standard_normal((2, SURFACE_WAVES)) / SURFACE_MM)
    surface = np.sqrt(2 / SURFACE_WAVES) * np.cos(modes + rng.uniform(0, 2 * np.pi, SURFACE_WAVES)).sum(axis=1)
    low, high = np.transpose([DELAY_S, RELEASE_S])
    delays = rng.uniform(low, high, (len(positions_mm), 2))
    delays[:, 0] += rig.touch_s * surface
    return np.maximum(delays, 0)


class Motion(NamedTuple):
    """Motion of the probe in the cycle of each press and in the next cycle; shapes (Q, 2 readings)."""

    depth: Array  # relative, 0 to 1
    onset: Array  # part of the depth for which the response is still that of the onset


def probe_motion(cycle: Cycle, delays_s: Array) -> Motion:
    """Compute how the probe moves, from the delays (Q, 2) of `sample_delays`."""
    times_s = np.arange(2 * cycle.readings) / cycle.rate_hz
    pressed_s = times_s - cycle.down_index / cycle.rate_hz - delays_s[:, :1]
    released_s = times_s - cycle.readings / cycle.rate_hz - delays_s[:, 1:]
    depth = np.clip(pressed_s / TRAVEL_S, 0, 1) - np.clip(released_s / TRAVEL_S, 0, 1)
    return Motion(depth, depth * np.exp(-np.maximum(pressed_s, 0) / ONSET_S))


def scaled(responses: PressParts[Array], gains: Array) -> PressParts[Array]:
    """Multiply the responses (Q, C) during a press, not those after it, by gains (Q, C)."""
    held, onset, creep, after = responses
    return PressParts(gains * held, gains * onset, gains * creep, after)


class Strain(NamedTuple):
    """Strain of the fibres at each reading, which `Viscoelasticity` converts to a response; shapes (R, C)."""

    pressed: Array  # strain while the probe is in the silicone
    creeping: Array  # part of it that creep removes
    residue: Array  # change of the residues: left behind minus taken away


def superpose_strain(responses: PressParts[Array], replaced: Array, motion: Motion) -> Strain:
    """Superpose presses by overlap-add of their two cycles; responses and residues that they replace are (Q, C)."""
    readings = motion.depth.shape[1] // 2
    steps = np.diff(motion.depth, axis=1, prepend=0.0)
    strain = Strain(*np.zeros((3, len(steps) * readings, replaced.shape[1])))
    for cycle in (0, 1):  # the cycle of a press, and the next one, which overlaps with that of the next press
        presses, first = len(steps) - cycle, cycle * readings
        pressed = PressParts(*(part[:presses, None] for part in responses))
        motions = (values[:presses, first : first + readings, None] for values in (*motion, steps))
        for part, of_presses in zip(strain, strain_of(pressed, replaced[:presses, None], *motions), strict=True):
            part[first:] += of_presses.reshape(-1, part.shape[1])
    return strain


def strain_of(responses: PressParts[Array], replaced: Array, depth: Any, onset: Any, step: Any) -> Strain:
    """Compute the strain at a depth and onset, as in `Motion`, after a step of the depth since the last reading."""
    up, down = np.maximum(-step, 0), np.maximum(step, 0)
    pressed = depth * responses.held + onset * (responses.onset - responses.held)
    residue = up * (responses.after + RETURNED * replaced) - down * replaced
    return Strain(pressed, depth * responses.creep, residue)


class Viscoelasticity:
    """Creep, a low pass, and residues, which decay."""

    def __init__(self, rate_hz: float, rig: RigSettings) -> None:
        self._creep_decay = np.exp(-1 / (rate_hz * CREEP_S))
        self._residue_decay = np.exp(-1 / (rate_hz * rig.hysteresis_s))
        self._states: tuple[Array, Array] | None = None  # of the two filters

    def __call__(self, strain: Strain) -> Array:
        """Compute the response (R, C) to further strain; before the first strain, creep is in equilibrium with it."""
        creep_decay, residue_decay = self._creep_decay, self._residue_decay
        states = self._states or (creep_decay * strain.creeping[:1], np.zeros_like(strain.residue[:1]))
        creep, creep_state = lfilter([1 - creep_decay], [1.0, -creep_decay], strain.creeping, axis=0, zi=states[0])
        residue, residue_state = lfilter([1.0], [1.0, -residue_decay], strain.residue, axis=0, zi=states[1])
        self._states = creep_state, residue_state
        return strain.pressed - creep - residue


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


def adc_volts(volts: Array) -> Array:
    """Return voltages, V, quantized by an ADC of ADC_STEPS, within its range."""
    return np.clip(np.rint(volts / SUPPLY_V * ADC_STEPS), 0, ADC_STEPS) * (SUPPLY_V / ADC_STEPS)


class Divider:
    """Fibres in voltage dividers, read by an ADC; strain is a relative change of resistance, or in V if `linear`."""

    def __init__(
        self, fibres: int, rate_hz: float, rig: RigSettings, rng: np.random.Generator, linear: bool = False
    ) -> None:
        self.channels = fibres
        self._rest_v = rng.uniform(*REST_V, fibres)
        self._viscoelasticity = Viscoelasticity(rate_hz, rig)
        self._drift = Drift(fibres, rate_hz, rng)
        self._rig, self._rng, self._linear = rig, rng, linear

    def __call__(self, strain: Strain) -> Array:
        """Read the voltages (R, C) of further strain."""
        if not len(strain.pressed):
            return strain.pressed
        response = self._viscoelasticity(strain)
        volts = self._rest_v + response if self._linear else divider_voltage(self._rest_v, response)
        volts += self._rig.drift_mv * 1e-3 * self._drift(len(volts))
        volts += self._rig.noise_mv * 1e-3 * self._rng.standard_normal(volts.shape)
        return adc_volts(volts)


def simulate_readings(
    responses: PressParts[Array],
    positions_mm: Array,
    cycle: Cycle,
    rig: RigSettings,
    rng: np.random.Generator,
    noise_v: Array | None = None,
) -> Array:
    """Simulate the readings (Q readings, C), V, of presses (Q, 2), one in each cycle.

    Responses (Q, C) are relative changes of resistance. With `noise_v` (C,) they are V, as measured, and the responses
    of held presses have noise of that standard deviation, whatever their size.
    """
    presses, channels = responses.held.shape
    # The divider samples first, as in `LivePad`, so that fibres have the same rests there with the same seed.
    divider = Divider(channels, cycle.rate_hz, rig, rng, linear=noise_v is not None)
    interval_s = cycle.readings / cycle.rate_hz
    touch_s = interval_s * np.arange(presses)
    release_s = touch_s + (cycle.readings - cycle.down_index) / cycle.rate_hz
    replaced = replaced_residues(positions_mm, touch_s, release_s, responses.after, responses.held, rig)
    responses = scaled(responses, Gains(interval_s, channels, rig, rng)(presses))
    if noise_v is not None:
        press_noise_v = np.sqrt(np.maximum(noise_v**2 - _reading_noise_v(cycle, rig) ** 2, 0))
    else:
        # Near half of the supply the reading falls by a quarter of the supply for a relative change of 1.
        press_noise_v = 4e-3 / SUPPLY_V * rig.floor_mv
    held = responses.held + press_noise_v * rng.standard_normal((presses, channels))
    responses = responses._replace(held=held)
    return divider(superpose_strain(responses, replaced, probe_motion(cycle, sample_delays(positions_mm, rig, rng))))


def _reading_noise_v(cycle: Cycle, rig: RigSettings) -> float:
    """Return the standard deviation, V, that white noise and drift give to a held press minus the rest before it."""
    held = np.arange(cycle.held_index, cycle.readings)
    before = np.arange(cycle.down_index // 2, cycle.down_index)
    times_s = np.append(held, before) / cycle.rate_hz
    weights = np.append(np.full(len(held), 1 / len(held)), np.full(len(before), -1 / len(before)))
    correlation = np.exp(-np.abs(times_s[:, None] - times_s) / DRIFT_S)
    drift, white = weights @ correlation @ weights, weights @ weights
    return float(1e-3 * np.sqrt(rig.drift_mv**2 * drift + rig.noise_mv**2 * white))


class LivePad:
    """A simulated pad under a moving tip, in real time."""

    def __init__(
        self, pad: Morphology, contact: Contact, rig: RigSettings, rate_hz: float, rng: np.random.Generator
    ) -> None:
        channels = len(pad.knots)
        self._divider = Divider(channels, rate_hz, rig, rng)
        self._gains = Gains(rig.readings_per_press / rig.rate_hz, channels, rig, rng)
        self._pad, self._contact, self._rig, self._rate_hz = build_pad(pad, rig), contact, rig, rate_hz
        self._depth_mm = max(rig.press_depths_mm)
        self._responses: dict[tuple[float, float], PressParts[Array]] = {}  # (1, C) of the deepest press, by position
        self._presses: list[_PadPress] = []  # the latest ones
        self._depth, self._n_read = 0.0, 0

    def prepare(self) -> None:
        """Compile and solve a contact, so that the first press does not wait for it."""
        self._solve(np.zeros((1, 2)))

    def volts(self, positions_mm: Array, depths_mm: Array) -> Array:
        """Return the readings (R, C), V, at further positions (R, 2), from the centre, and depths (R,), < 0 above."""
        strain = Strain(*np.zeros((3, len(positions_mm), self._divider.channels)))
        self._solve(positions_mm[depths_mm > 0])
        for row, depth in enumerate(np.maximum(depths_mm / self._depth_mm, 0).tolist()):
            step, self._depth = depth - self._depth, depth
            time_s = (self._n_read + row) / self._rate_hz
            if depth == step == 0:  # the tip stays above the pad
                continue
            if step == depth:  # it was above the pad before
                self._touch(positions_mm[row], time_s)
            press = self._presses[-1]
            moved = np.zeros_like(press.replaced)
            if depth:
                press.release_s = time_s
                if _rounded(positions_mm[row]) != _rounded(press.position_mm):
                    moved = self._slide(press, positions_mm[row])
            onset = depth * math.exp((press.touch_s - time_s) / ONSET_S)
            parts = strain_of(scaled(press.response, press.gains), press.replaced, depth, onset, step)
            for part, of_press in zip(strain, parts, strict=True):
                part[row] = of_press
            strain.residue[row] -= depth * moved[0]
        self._n_read += len(positions_mm)
        return self._divider(strain)

    def _touch(self, position_mm: Array, time_s: float) -> None:
        """Start a press, which removes residues of earlier ones."""
        response = self._responses[_rounded(position_mm)]
        press = _PadPress(position_mm, time_s, time_s, self._gains(1), response, np.zeros_like(response.held))
        self._presses = [*self._presses[-MAX_LAG:], press]
        press.replaced = self._replaced()

    def _slide(self, press: "_PadPress", position_mm: Array) -> Array:
        """Move a press; return the residues (1, C) that it removes at the new position minus those at the old one.

        A sliding press is at any time like one made at its present position; it leaves no residue on its way.
        """
        before = press.replaced
        press.position_mm, press.response = position_mm, self._responses[_rounded(position_mm)]
        press.replaced = self._replaced()
        return press.replaced - before

    def _replaced(self) -> Array:
        """Return the residues (1, C) that the latest press removes."""
        presses = [
            (press.position_mm, press.touch_s, press.release_s, press.response.after[0], press.response.held[0])
            for press in self._presses
        ]
        return replaced_residues(*map(np.array, zip(*presses, strict=True)), self._rig)[-1:]

    def _solve(self, positions_mm: Array) -> None:
        """Compute the responses at positions (n, 2) together, and forget those at other positions."""
        new = dict.fromkeys(_rounded(position) for position in positions_mm)
        if not new.keys() <= self._responses.keys():
            rounded = np.array(list(new))
            depths_mm = np.full(len(rounded), self._depth_mm)
            parts = resistance_changes(self._pad, rounded, depths_mm, self._contact, self._rig)
            self._responses = {
                position: PressParts(*(part[row : row + 1] for part in parts)) for row, position in enumerate(new)
            }


def _rounded(position_mm: Array) -> tuple[float, float]:
    """Round to 0.01 mm, since the tip of an arm at rest moves by less."""
    x, y = np.round(position_mm, 2).tolist()
    return x, y


@dataclass
class _PadPress:
    """A press of a `LivePad`."""

    position_mm: Array
    touch_s: float
    release_s: float
    gains: Array
    response: PressParts[Array]  # at the full depth
    replaced: Array  # residues of earlier presses that it removes
