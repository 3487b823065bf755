"""Simulated recordings of presses, by the contact model or a twin; and measured settings for such a simulation.

`measure_rig_settings` estimates the noise, drift and hysteresis of a recorded pad. The rests before presses differ,
since the residues of presses decay; their variogram separates this decay, over some presses, from drift over minutes.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from math import ceil
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import nnls

from padforge.common.settings import or_default
from padforge.common.validation import InputError, check_int
from padforge.design import Contact, Morphology, Twin
from padforge.design.contact import contact_press
from padforge.design.settings import PadSettings
from padforge.design.twin import PARTS, TwinChannel, TwinPart
from padforge.sense.arrays import MAX_FIBRES, MIN_SCALE_V, Array, press_bounds
from padforge.sense.recording.press_plan import (
    PositionTest,
    PressPlan,
    check_depths,
    deepest_contact,
    fit_pad_settings,
    make_plan,
    make_plan_in,
    pad_source,
    pressable_test,
    sample_uniform,
)
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.built_pad import PressParts, build_pad
from padforge.sense.simulation.pad_model import DRIFT_S, FULL_DEPTH_MM, Cycle, resistance_changes, simulate_readings

MIN_SINGULAR = 0.3  # relative singular value below which both sides count as equal: on a pad turned by over 28 degrees
JITTER = 0.1  # standard deviation of the interval between readings, relative to its mean
MIN_PRESSES = 100  # minimum number of presses for a measurement of noise, drift and hysteresis
REST_S = 0.7  # time before a press in which fibres rest


@dataclass(frozen=True)
class PadModel:
    """A pad of C channels to be simulated."""

    corners_mm: Array  # low and high corner of the pressed area, in the frame of the arm; shape (2, 2)
    free: PositionTest  # which positions (Q, 2) may be pressed
    responses: Callable[[Array, Array], PressParts[Array]]  # function of positions (Q, 2) and depths (Q,), mm
    source: dict[str, Any]  # description of the pad for the recording, JSON
    noise_v: Array | None = None  # noise of responses in V; None for relative changes of resistance


def model_plan(
    pad: Morphology, contact: Contact, rig: RigSettings, pad_settings: PadSettings | None = None
) -> PadModel:
    """Model a pad that is built as `[rig]` says, and pressed in the area of `pad_settings`, see `fit_pad_settings`."""
    pad_settings = fit_pad_settings(pad, pad_settings)
    keys = {"sensed_mm", "keep_out_mm"} if pad_settings.keep_out_mm else {"sensed_mm"}
    source = {"contact": contact.model_dump(mode="json"), "morphology": pad_source(pad)}
    source |= pad_settings.model_dump(mode="json", include=keys)

    def responses(positions_mm: Array, depths_mm: Array) -> PressParts[Array]:
        return resistance_changes(build_pad(pad, rig), positions_mm, depths_mm, contact, rig)

    return PadModel(pad.to_mm(pad_settings.sensed), pressable_test(pad, pad_settings), responses, source)


def model_twin(twin: Twin, rig: RigSettings, pad_settings: PadSettings | None = None) -> PadModel:
    """Model the pad of a twin: fibres as built and wired, pressed where the arm pressed; dead channels stay at rest."""
    columns, live = _live_channels(twin)
    fibres = np.array([channel.fibre for channel in live])
    gains_v = np.array([channel.gain_v for channel in live])
    noise_v = np.zeros(len(twin.channels))
    noise_v[columns] = [channel.noise_v for channel in live]

    def responses(positions_mm: Array, depths_mm: Array) -> PressParts[Array]:
        parts = np.zeros((len(PARTS), len(positions_mm), len(twin.channels)))
        for name, part in zip(PARTS, parts, strict=True):
            if name in twin.parts:
                stretch = twin.as_built_stretch(positions_mm, name)[:, fibres]
                part[:, columns] = twin.parts[name].gains_v[columns] * stretch
            else:
                part[:, columns] = _share(name, rig) * gains_v * twin.as_built_stretch(positions_mm)[:, fibres]
        if twin.residual is not None:
            positions = (positions_mm - twin.residual.middle_mm) / twin.residual.half_mm
            maps = twin.residual.volts.transpose(2, 3, 0, 1)
            axis = np.linspace(-1, 1, len(maps))
            residual = RegularGridInterpolator((axis, axis), maps)(np.clip(positions, -1, 1))
            parts += residual.transpose(1, 0, 2)
        held, onset, creep, after = depths_mm[:, None] / FULL_DEPTH_MM * parts
        return PressParts(held, onset, creep, after)

    # Least squares for the sides, along the axes of the arm, that span `sensed_mm` along the axes of the plan.
    spans = np.abs(twin.frame.turned(np.eye(2))).T
    sides, *_ = np.linalg.lstsq(spans, np.array(twin.sensed_mm) / twin.frame.scale, rcond=MIN_SINGULAR)
    half_mm = np.maximum(sides, 0) / 2
    plan = model_plan(twin.morphology, twin.contact(), rig, pad_settings)
    return replace(
        plan,
        corners_mm=np.array([-half_mm, half_mm]),
        free=lambda positions_mm: plan.free(twin.frame.to_plan(positions_mm)),
        responses=responses,
        **_measured(twin, noise_v, plan.source | {"sensed_mm": (2 * half_mm).tolist()}),
    )


def model_like_twin(pad: Morphology, twin: Twin, rig: RigSettings, pad_settings: PadSettings | None = None) -> PadModel:
    """Model another pad by its plan, with the contacts of a twin, and its median gains and noise.

    The differences of its channels are unknown before it is made: fibre i is on channel i, and all have the same gain.
    """
    columns, live = _live_channels(twin)
    plan = model_plan(pad, twin.contact(), rig, pad_settings)
    noise_v = np.full(len(pad.knots), np.median([channel.noise_v for channel in live]))
    plain, gain_v = twin.contact(), _median_gain(np.array([channel.gain_v for channel in live]))
    parts = [twin.parts.get(name) for name in PARTS]
    contacts = PressParts(*(plain if part is None else part.contact() for part in parts))
    gains_v = [
        _share(name, rig) * gain_v if part is None else _median_gain(part.gains_v[columns])
        for name, part in zip(PARTS, parts, strict=True)
    ]
    built = build_pad(pad, rig)

    def responses(positions_mm: Array, depths_mm: Array) -> PressParts[Array]:
        stretch = built.stretch(positions_mm, contacts)
        depth = depths_mm[:, None] / FULL_DEPTH_MM
        return PressParts(*(gain_v * depth * part for gain_v, part in zip(gains_v, stretch, strict=True)))

    return replace(plan, responses=responses, **_measured(twin, noise_v, plan.source))


def _median_gain(gains_v: Array) -> float:
    return float(np.copysign(np.median(np.abs(gains_v)), gains_v.sum()))


def _share(part: str, rig: RigSettings) -> float:
    """Return the size of a part, relative to the held response, if the twin has no measurement of it."""
    return {"held": 1.0, "onset": 1.0, "creep": rig.creep, "after": rig.hysteresis}[part]


def _live_channels(twin: Twin) -> tuple[list[int], list[TwinChannel]]:
    """Return the channels that read a fibre, and their indices."""
    columns = [column for column, channel in enumerate(twin.channels) if channel.fibre is not None]
    if not columns:
        raise InputError("twin: none of its channels reads a fibre, expected one that does")
    return columns, [twin.channels[column] for column in columns]


def _measured(twin: Twin, noise_v: Array, source: dict[str, Any]) -> dict[str, Any]:
    """Return the fields `noise_v` and `source` of a `PadModel` that resembles a twin."""
    description = {"presses": twin.presses, "noise": twin.noise, "provenance": dict(twin.provenance)}
    return {"noise_v": twin.scatter.floor * noise_v, "source": source | {"twin": description}}


def measured_rig(twin: Twin, rig: RigSettings) -> RigSettings:
    """Return `[rig]` with the values that were measured on a pad."""
    measured = asdict(twin.readings) if twin.readings else {}
    measured |= {"scatter": twin.scatter.share, "scatter_common": twin.scatter.common}
    held = _log_sensitivities(twin.parts.get("held", twin))
    if held is not None:
        sensitivities = [_log_sensitivities(twin.parts[name]) for name in PARTS[1:] if name in twin.parts]
        differences = [part - held for part in sensitivities if part is not None]
        measured |= {"sensitivity": min(float(held.std()), 2.0)}
        measured |= {"own_sensitivity": min(float(np.std(differences)), 2.0)} if differences else {}
    return rig.model_copy(update=measured)


def _log_sensitivities(part: Twin | TwinPart) -> Array | None:
    """Return the logarithms of the sensitivities along all fibres, each of zero mean; None if all are uniform."""
    rows = [np.log(np.maximum(row, 1e-3)) for row in part.sensitivity or () if row is not None]
    return np.concatenate([row - row.mean() for row in rows]) if rows else None


def simulate(
    pad: Morphology | Twin,
    rig: RigSettings | None = None,
    contact: Contact | None = None,
    pad_settings: PadSettings | None = None,
    like: Twin | None = None,
) -> Recording:
    """Simulate a recording of the presses that `[rig]` plans.

    A press takes a cycle of readings: the probe is sent down in its middle, and up at its end.

    Args:
        pad: paths of the fibres; or a twin, which responds, and is pressed, like the pad that it was measured on.
        rig: plan, depths, rate, seed, noise, drift, creep, hysteresis and scatter; measured values of a twin replace
            them.
        contact: contact model; that of a twin replaces it.
        pad_settings: pressed area and keep-outs of the pad; for a twin only the keep-outs.
        like: twin of another pad, whose sensitivity, gain and noise `pad` takes over.

    Returns:
        The recording, the same for the same arguments.

    Raises:
        InputError: more fibres than a recording may have, presses beyond the pad or in its keep-outs, an adaptive plan
            or a plan file without positions, or a twin of which no channel reads a fibre.
    """
    contact, rig = or_default("contact", contact, Contact), or_default("rig", rig, RigSettings)
    channels = len(pad.channels) if isinstance(pad, Twin) else len(pad.knots)
    check_int("fibres of the pad", channels, 1, MAX_FIBRES)
    _check_plan_kind(rig)
    if measured := pad if isinstance(pad, Twin) else like:
        rig, contact = measured_rig(measured, rig), measured.contact()
    rig = rig.for_contact(contact)
    if isinstance(pad, Twin):
        model = model_twin(pad, rig, pad_settings)
    elif like is None:
        model = model_plan(pad, contact, rig, pad_settings)
    else:
        model = model_like_twin(pad, like, rig, pad_settings)
    rng = np.random.default_rng(rig.seed)
    plan = make_plan_in(model.corners_mm, rig, rng, model.free)
    cycle = Cycle(rig.readings_per_press, rig.rate_hz)
    responses = model.responses(plan.positions_mm, plan.depths_mm)
    readings = simulate_readings(responses, plan.positions_mm, cycle, rig, rng, model.noise_v)
    intervals_s = (1 + JITTER * np.clip(rng.standard_normal(len(readings)), -3, 3)) / rig.rate_hz
    first = cycle.readings * np.arange(len(plan))
    return Recording(
        readings,
        np.cumsum(intervals_s),
        plan.positions_mm,
        down_command=first + cycle.down_index,
        up_command=first + cycle.readings,
        depths_mm=plan.depths_mm,
        source={"kind": "simulated", "rig": rig.model_dump(mode="json"), **model.source},
    )


def plan_simulation(
    pad: Morphology, rig: RigSettings, contact: Contact, pad_settings: PadSettings | None = None
) -> PressPlan:
    """Return the presses that `simulate` makes on any pad of the same layout, and raise InputError as it does."""
    _check_plan_kind(rig)
    plan = make_plan(pad, rig, np.random.default_rng(rig.seed), pad_settings)
    if contact.model == "layer":
        check_depths(plan.depths_mm, contact.thickness_mm, "the thickness of the pad")
        contact_press(deepest_contact(contact, plan.depths_mm))
    return plan


def _check_plan_kind(rig: RigSettings) -> None:
    if rig.plan == "adaptive":
        raise InputError("[rig] plan is adaptive, allowed in a simulation are uniform, grid, serpentine or a .csv file")


def sample_positions(
    pad: Morphology, presses: int, rng: np.random.Generator, pad_settings: PadSettings | None = None
) -> Array:
    """Sample positions (Q, 2), mm, uniformly over the pressed area of a pad, see `fit_pad_settings`."""
    pad_settings = fit_pad_settings(pad, pad_settings)
    return sample_uniform(pad.to_mm(pad_settings.sensed), presses, rng, pressable_test(pad, pad_settings))


def measure_rig_settings(recording: Recording) -> dict[str, float]:
    """Measure the `noise_mv`, `drift_mv` and `hysteresis_s` of `[rig]` in a recording.

    Channels that miss readings or are constant are ignored. Returns {} for fewer than MIN_PRESSES, or without channels.
    """
    down_command, up_command, rate_hz = recording.down_command[:-1], recording.up_command[:-1], recording.rate_hz
    valid = np.isfinite(recording.readings).all(axis=0) & (np.ptp(recording.readings, axis=0) > MIN_SCALE_V)
    if len(down_command) < MIN_PRESSES or not valid.any():
        return {}
    readings, rested = recording.readings[:, valid], ceil(REST_S * rate_hz)
    previous_end, _ = press_bounds(down_command, up_command, len(readings))
    first = np.maximum(down_command - rested, previous_end)
    rests = zip(first, np.maximum(down_command, first + 1), strict=True)
    baseline = np.array([readings[start:end].mean(axis=0) for start, end in rests])
    decay_s, drift_v = _fit_variogram(baseline, float(np.median(np.diff(recording.times_s[down_command]))))
    middle = (down_command + up_command) // 2
    second_differences = readings[middle - 1] - 2 * readings[middle] + readings[middle + 1]
    return {
        # The variance of a second difference of white noise is six times that of the noise.
        "noise_mv": 1e3 * float(np.sqrt((second_differences**2).mean() / 6)),
        "drift_mv": 1e3 * drift_v,
        "hysteresis_s": decay_s,
    }


def _fit_variogram(baseline: Array, interval_s: float) -> tuple[float, float]:
    """Fit decaying hysteresis and drift to the variogram of rests (Q, C); return decay time, s, and drift, V."""
    lags = np.unique(np.geomspace(1, len(baseline) // 2, 24).astype(int))
    variogram = np.array([((baseline[lag:] - baseline[:-lag]) ** 2).mean() / 2 for lag in lags])
    fits: list[tuple[float, float, float]] = []
    for decay_s in np.geomspace(1.0, 100.0, 41).tolist():  # time constants of hysteresis
        models = 1 - np.exp(-lags[:, None] * interval_s / np.array([decay_s, DRIFT_S]))
        (_, drift), error = nnls(models / np.maximum(variogram, MIN_SCALE_V**2)[:, None], np.ones(len(lags)))
        fits.append((float(error), decay_s, float(np.sqrt(drift))))
    return min(fits)[1:]
