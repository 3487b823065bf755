"""Drift: what denoising the readings and taking their drift off bring, on simulated and on real recordings.

The published way (paper, section V-A, figure 12 and table III) filters the readings by total variation, and gives the
network what each fibre reads before, in and after a press. Here every filter is tried with every way of taking the
drift off; the network is the published one throughout.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from padforge.design.common.parallel import State
from padforge.design.common.validation import InputError
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.networks import training_presses
from padforge.design.objectives.published import idle_share
from padforge.design.settings import PUBLISHED_CONTACT, between_fibres
from padforge.sense.localizer.calibration.calibration import split_presses
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.evaluation import idle_share as recorded_idle_share
from padforge.sense.localizer.features import bridged, press_inputs
from padforge.sense.recordings.processing.filters import running_median, total_variation
from padforge.sense.recordings.processing.limits import Array, Indices
from padforge.sense.recordings.recording import Recording
from padforge.sense.recordings.simulation.published_protocol import simulate
from padforge.sense.settings import RigSettings
from padforge.sense.studies.pads import described
from padforge.sense.studies.study import Findings, Study, Task

from padforge.sense.studies.drift.figure import draw
from padforge.sense.studies.drift.text import told

MEMBERS = 3
"""Networks whose errors are averaged: they differ by their first weights."""
SIDE = 32
"""Presses along a side of the published serpentine that idle shares are taken on in simulation."""
SETTLED = 10
"""Readings from a command of the probe to the value taken, as published: 10, 30 and 50 of a cycle of 40."""
SLOW_PRESSES = 15
"""Presses, the last included, of whose rests the median is the slow rest."""
SHOWN = 5
"""Presses in the figure's stretch of readings."""
LEVELS = 400
"""Presses by which the figure shows the drift of a whole recording, at most."""
RAW, AS_PUBLISHED = "none", "robust TV"
"""No filter, and the published one."""
FILTERS: dict[str, Callable[[Array], Array]] = {
    RAW: lambda readings: readings,
    "median of 15": partial(running_median, width=15),
    AS_PUBLISHED: partial(total_variation, lam=4.0),
    "squares TV": partial(total_variation, lam=0.01, fidelity="squares"),
}
"""Ways of denoising (R, C) volts. The last one's lam is in volts: a press of 20 readings is lowered by 1 mV."""
SIMULATED = "simulated"
"""What a simulated recording says in its source, and rows say of it."""
SCHEMES = ("none", "rest taken off", "slow rest taken off", "published", "windows")
"""Ways of taking the drift off, as `scheme_inputs` knows them."""


@dataclass(frozen=True)
class Split:
    """Presses by index: to learn from, to end the training by, and to test on, at random and at the end."""

    taught: Indices
    checked: Indices
    test: Indices
    last: Indices


def drift_study(
    pads: Mapping[str, Morphology],
    recordings: Mapping[str, Recording],
    *,
    rig: RigSettings | None = None,
    presses: int = 1000,
    test_share: float = 0.15,
    hidden: int = 50,
    epochs: int = 200,
    seed: int = 0,
) -> Study:
    """What every filter with every way of taking the drift off brings, and how often fibres are idle.

    Findings are the same for the same arguments, but for the seconds that the filters took.

    Args:
        pads: by label, each recorded by the simulated rig. recordings: by label.
        rig: strengths of the simulated noise, drift, creep and hysteresis, and its cycle. presses: of a simulated pad.
        test_share: share of the presses held back at random, and again at the end. hidden, epochs: of a network.
        seed: of simulated recordings, splits and networks.

    Raises:
        InputError: neither a pad nor a recording, a label used twice, or too few presses of known place.
    """
    if not pads and not recordings:
        raise InputError("study has neither a morphology nor a recording, expected at least one of them")
    twice = sorted(pads.keys() & recordings.keys())
    if twice:
        raise InputError(f"{twice[0]}: both a morphology and a recording are called so, expected each label once")
    drawn = int(np.random.default_rng([6, seed]).integers(2**32))
    rig = (rig or RigSettings()).model_copy(update={"presses": presses, "seed": drawn})
    sources: dict[str, Callable[[], Recording]] = {label: partial(simulate, pad, rig) for label, pad in pads.items()}
    sources |= {label: (lambda own=recording: own) for label, recording in recordings.items()}
    simulated = {*pads, *(label for label, own in recordings.items() if own.source.get("kind") == SIMULATED)}
    kinds = {label: SIMULATED if label in simulated else "recorded" for label in sources}
    known = {**dict.fromkeys(pads, presses), **{label: int(own.known.sum()) for label, own in recordings.items()}}
    for label, count in known.items():
        try:
            _split(np.arange(count), test_share, seed)
        except InputError as error:
            raise InputError(f"{label}: {error}") from error
    tasks = [
        Task(f"{label}, denoised by {name}", partial(_tried, source, name, test_share, hidden, epochs, seed))
        for label, source in sources.items()
        for name in FILTERS
    ]
    settings = {
        "pads": described(pads),
        "recordings": {label: recording.digest for label, recording in recordings.items()},
        "rig": rig.model_dump(mode="json"),
        "denoise": list(FILTERS),
        "compensate": list(SCHEMES),
        "test_share": test_share,
        "members": MEMBERS,
        "hidden": hidden,
        "epochs": epochs,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), kinds, settings)
    return Study("drift", "Denoising and drift compensation", settings, tasks, conclude, draw)


def _split(known: Indices, share: float, seed: int) -> Split:
    """Presses `known`: the last ones held back, of the others some at random, and of those left some to end by."""
    rng = np.random.default_rng([7, seed])
    rest, last = split_presses(len(known), "chronological", share, rng)
    training, test = split_presses(len(rest), "random", share, rng)
    taught, checked = split_presses(len(training), "random", share, rng)
    return Split(known[training[taught]], known[training[checked]], known[test], known[last])


def values(readings: Array, begun: Indices, lifted: Indices) -> Array:
    """What each fibre reads before, in and after each press, `SETTLED` readings from the probe's commands.

    Where a cycle is too short for that, the nearest reading is taken that belongs neither to the press's other phases
    nor to a neighbouring press.

    Args:
        readings: (R, C) volts. begun, lifted: (Q,) first reading after the probe was sent down, and up.

    Returns:
        (Q, C, 3) volts.
    """
    return np.stack([readings[at] for at in _places(len(readings), begun, lifted)], axis=2)


def _places(readings: int, begun: Indices, lifted: Indices) -> tuple[Indices, Indices, Indices]:
    """(Q,) which readings are those of before, in and after each press."""
    free, following = np.concatenate([[0], lifted[:-1]]), np.concatenate([begun[1:], [readings]])
    return (
        np.maximum(begun - SETTLED, free),
        np.minimum(begun + SETTLED, lifted - 1),
        np.minimum(lifted + SETTLED, following - 1),
    )


def scheme_inputs(name: str, readings: Array, begun: Indices, lifted: Indices, taught: Indices) -> Array:
    """(Q, D) what a network is given of each press when the drift is taken off as `name`, one of `SCHEMES`, says.

    "windows" are the windows of `press_inputs`, of which the principal components are taken that are as many as
    "published" has inputs: else the networks would differ by their size.

    Args:
        readings: (R, C) volts, none missing. begun, lifted: as `values`.
        taught: presses that the principal components are of.
    """
    if name == "windows":
        windows = press_inputs(readings, begun, lifted, "full").windows.reshape(len(begun), -1)
        middle = windows[taught].mean(axis=0)
        axes = np.linalg.eigh(np.cov(windows[taught], rowvar=False))[1]
        return (windows - middle) @ axes[:, -3 * readings.shape[1] :]
    before, pressed, after = np.moveaxis(values(readings, begun, lifted), 2, 0)
    if name == "published":
        return np.hstack([before, pressed, after])
    if name == "rest taken off":
        return pressed - before
    return pressed - running_median(before, SLOW_PRESSES, causal=True) if name == "slow rest taken off" else pressed


def _tried(source: Callable[[], Recording], name: str, share: float, hidden: int, epochs: int, seed: int) -> State:
    """Errors of the networks of each scheme on readings denoised by the filter `name`.

    Returns:
        "test_S" and "last_S" for scheme number S: (MEMBERS, T) errors, mm. "seconds": () for 10 000 readings. "idle":
        () share of presses in which a fibre is idle. Of the fibre that answers most, its number "fibre"; "stretch":
        (3, W) times s, readings and filtered readings V; "marks": (SHOWN, 3, 2) times s and values V; and "levels":
        (L, 3) times s, and values V before and in presses.
    """
    from padforge.design.networks import fit_batch

    recording = source()
    begun, lifted, places_mm = recording.begun, recording.lifted, recording.presses_mm
    readings = bridged(recording.readings)
    FILTERS[name](readings[:2])  # compiled before the clock runs
    clock = perf_counter()
    filtered = FILTERS[name](readings)
    state: State = {"seconds": np.array((perf_counter() - clock) * 1e4 / len(readings))}
    state["idle"] = np.array(recorded_idle_share(replace(recording, readings=filtered)).mean())
    split = _split(np.flatnonzero(recording.known), share, seed)
    for number, scheme in enumerate(SCHEMES):
        inputs = scheme_inputs(scheme, filtered, begun, lifted, split.taught)
        rngs = np.random.default_rng([8, seed]).spawn(MEMBERS)
        check = np.broadcast_to(inputs[split.checked], (MEMBERS, len(split.checked), inputs.shape[1]))
        networks = fit_batch(
            inputs[split.taught], places_mm[split.taught], rngs, hidden, epochs, (check, places_mm[split.checked])
        )
        for kind, rows in (("test", split.test), ("last", split.last)):
            found = [distances(network(inputs[rows]), places_mm[rows]) for network in networks]
            state[f"{kind}_{number}"] = np.stack(found)
    return state | _shown(recording.times_s, readings, filtered, begun, lifted)


def _shown(times_s: Array, readings: Array, filtered: Array, begun: Indices, lifted: Indices) -> State:
    """What the figure needs of a recording: see `_tried`."""
    taken = values(filtered, begun, lifted)
    answers = taken[:, :, 1] - taken[:, :, 0]
    fibre = int(np.argmax(answers.std(axis=0)))
    shown = min(SHOWN, len(begun))
    first = int(np.argmax(np.convolve(np.abs(answers[:, fibre]), np.ones(shown), "valid")))
    at = np.stack(_places(len(readings), begun, lifted), axis=1)
    presses = slice(first, first + shown)
    window = slice(max(0, at[first, 0] - SETTLED), at[first + shown - 1, 2] + SETTLED)
    some = np.unique(np.linspace(0, len(begun) - 1, LEVELS).astype(int))
    return {
        "stretch": np.stack([times_s[window], readings[window, fibre], filtered[window, fibre]]),
        "marks": np.stack([times_s[at[presses]], taken[presses, fibre]], axis=2),
        "levels": np.column_stack([times_s[begun[some]], taken[some, fibre, :2]]),
        "fibre": np.array(fibre),
    }


def _conclude(
    pads: Mapping[str, Morphology], kinds: Mapping[str, str], settings: Mapping[str, Any], states: list[State]
) -> Findings:
    rows, stretches, idle = [], [], []
    results = iter(states)
    for label, kind in kinds.items():
        if label in pads:
            places = training_presses(between_fibres(pads[label].layout), SIDE, settings["seed"])
            touched = signals(pads[label], places, PUBLISHED_CONTACT)
            idle.append({"label": label, "kind": "contact model", "idle_percent": 100 * idle_share(touched)})
        for name in FILTERS:
            state = next(results)
            rows += [_row(label, kind, name, scheme, number, state) for number, scheme in enumerate(SCHEMES)]
            if name in (RAW, AS_PUBLISHED):
                what = f"{kind} readings" if name == RAW else f"{kind} readings, denoised"
                idle.append({"label": label, "kind": what, "idle_percent": 100 * float(state["idle"])})
            if name == AS_PUBLISHED:
                parts = {part: state[part].tolist() for part in ("fibre", "stretch", "marks", "levels")}
                stretches.append({"recording": label, "kind": kind, **parts})
    return Findings(rows, told(settings, rows, idle), {"idle": idle, "stretches": stretches})


def _row(label: str, kind: str, name: str, scheme: str, number: int, state: State) -> dict[str, Any]:
    test, last = state[f"test_{number}"], state[f"last_{number}"]
    return {
        "recording": label,
        "kind": kind,
        "denoise": name,
        "compensate": scheme,
        "mean_mm": float(test.mean()),
        "median_mm": float(np.median(test)),
        "p95_mm": float(np.percentile(test, 95)),
        "std_mm": float(test.mean(axis=1).std()),
        "mean_last_mm": float(last.mean()),
        "std_last_mm": float(last.mean(axis=1).std()),
        "seconds_per_10000": None if name == RAW else float(state["seconds"]),
    }
