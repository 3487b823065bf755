"""The figure of the study of drift.

What the study of drift shows, in sentences.

Drift: what denoising the readings and taking their drift off bring, on simulated and on real recordings.
The published way (paper, section V-A, figure 12 and table III) filters the readings by total variation, and gives the
network what each fibre reads before, in and after a press. Here every filter is tried with every way of taking the
drift off; the network is the published one throughout.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import ALARM, CURVES, FAINT, INK, add_title, style_axes
from padforge.design.common.validation import InputError
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.networks import training_presses
from padforge.design.objectives.published import idle_share
from padforge.design.settings import PUBLISHED_CONTACT, between_fibres
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.calibration import split_presses
from padforge.sense.localizer.evaluation import ACTIVE, distances
from padforge.sense.localizer.evaluation import idle_share as recorded_idle_share
from padforge.sense.localizer.features import compute_features, interpolate_gaps
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.signals.filters import running_median, total_variation
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.studies.study import Findings, Study, Task, described

COLUMNS = 2
"""Recordings side by side whose errors are shown."""
PHASES = (("before", INK), ("pressed", ALARM), ("after", CURVES[2]))


def draw(document: Mapping[str, Any]) -> Figure:
    """Drift of a fibre, its readings and what is taken of them, and the errors of every way to deal with it.

    Readings are shown of the first simulated and of the first real recording.
    """
    stretches, rows = document["stretches"], document["rows"]
    shown = [next(s for s in stretches if s["kind"] == kind) for kind in dict.fromkeys(s["kind"] for s in stretches)]
    labels = list(dict.fromkeys(row["recording"] for row in rows))
    lines = -(-len(labels) // COLUMNS)
    schemes = len(document["settings"]["compensate"])
    each = 0.62 * schemes + 0.9
    figure = Figure(figsize=(11, 2.7 * len(shown) + each * lines + 0.9), layout="constrained")
    grid = figure.add_gridspec(len(shown) + lines, 6, height_ratios=[2.7] * len(shown) + [each] * lines)
    for at, stretch in enumerate(shown):
        _levels(figure.add_subplot(grid[at, :2]), stretch)
        axes = figure.add_subplot(grid[at, 2:])
        _readings(axes, stretch)
        if at == 0:
            axes.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), ncols=5, borderaxespad=0)
    width = 6 // min(len(labels), COLUMNS)
    for at, label in enumerate(labels):
        column = width * (at % COLUMNS)
        axes = figure.add_subplot(grid[len(shown) + at // COLUMNS, column : column + width])
        _errors(axes, label, [row for row in rows if row["recording"] == label])
        if at == 0:
            figure.legend(
                *axes.get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside lower left", ncols=5
            )
    told = "errors on presses never trained on: filled for presses at random, hollow for the last"
    add_title(figure, f"Drift of a fibre, and {told}")
    return figure


def _levels(axes: Axes, stretch: Mapping[str, Any]) -> None:
    """The values before and in presses, over the whole recording."""
    times_s, *volts = np.array(stretch["levels"]).T
    for (name, colour), own in zip(PHASES[:2], volts, strict=True):
        axes.scatter(times_s / 60, own, s=2.5, color=colour, label=name, linewidths=0)
    axes.set(xlabel="time (min)", ylabel="filtered (V)")
    axes.set_title(f"{stretch['recording']}, fibre {stretch['fibre'] + 1}", loc="left", color=INK, fontsize=10)
    style_axes(axes)


def _readings(axes: Axes, stretch: Mapping[str, Any]) -> None:
    """Some presses, as read and filtered, and the three values that are taken of each."""
    times_s, raw, filtered = np.array(stretch["stretch"])
    start = times_s[0]
    axes.plot(times_s - start, raw, color=CURVES[-1], linewidth=0.7, alpha=0.7, label="readings")
    axes.plot(times_s - start, filtered, color=CURVES[1], linewidth=1.3, label="filtered")
    # The value after a press is the one before the next: the ring shows around the dot.
    by_phase = np.array(stretch["marks"]).swapaxes(0, 1)
    for (name, colour), marks, size in zip(PHASES, by_phase, (4, 5, 8), strict=True):
        face = "none" if name == "after" else colour
        axes.plot(
            marks[:, 0] - start, marks[:, 1], "o", color=colour, markerfacecolor=face, markersize=size, label=name
        )
    axes.set(xlabel=f"time since {start / 60:.1f} min (s)", ylabel="V")
    style_axes(axes)


def _errors(axes: Axes, label: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """A dot for every way: filled for presses at random, hollow for the last ones."""
    schemes = list(dict.fromkeys(row["compensate"] for row in rows))
    filters = list(dict.fromkeys(row["denoise"] for row in rows))
    for at, name in enumerate(filters):
        own = [row for row in rows if row["denoise"] == name]
        heights = np.arange(len(schemes)) + 0.6 * ((at + 0.5) / len(filters) - 0.5)
        for part, face in (("", CURVES[at]), ("_last", "none")):
            means, stds = ([row[f"{what}{part}_mm"] for row in own] for what in ("mean", "std"))
            dot: dict[str, Any] = {"fmt": "o", "color": CURVES[at], "markerfacecolor": face, "markersize": 4.5}
            axes.errorbar(means, heights, xerr=stds, elinewidth=1, label=None if part else f"denoised: {name}", **dot)
    axes.set_yticks(range(len(schemes)), schemes)
    axes.set(ylim=(len(schemes) - 0.5, -0.5), xlim=(0, None), xlabel="mean error (mm)")
    axes.set_title(f"{label}, {rows[0]['kind']}", loc="left", color=INK, fontsize=10)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    style_axes(axes)


Rows = Sequence[Mapping[str, Any]]

TABLE_III = (
    "Table III of the paper has 78 % (square) and 77 % (N = 5) in its experiment, by the rule of 2 %. Its published "
    "recording of the pad of N = 5 gives 16 to 18 % by that rule, whether readings are denoised or not: the table "
    "cannot be reproduced from the data."
)
"""Said with every study, for whoever compares."""


def told(settings: Mapping[str, Any], rows: Rows, idle: Rows) -> list[str]:
    """Paragraphs about the rows of the study and its idle shares ("label", "kind", "idle_percent")."""
    share = 100 * settings["test_share"]
    text = [
        f"Networks of {settings['hidden']} neurons find presses from readings denoised in {len(settings['denoise'])} "
        f"ways, whose drift is taken off in {len(settings['compensate'])}. Errors are means of {settings['members']} "
        f"networks, on presses never trained on: {share:g} % drawn at random, and the last {share:g} % of the "
        "recording, by which the drift has gone on."
    ]
    for label in dict.fromkeys(row["recording"] for row in rows):
        text.append(_of_recording([row for row in rows if row["recording"] == label]))
    model = [each for each in idle if each["kind"] == "contact model"]
    if model:
        shares = _listed([f"{each['idle_percent']:.1f} % ({each['label']})" for each in model])
        text.append(f"By the contact model a fibre is idle in {shares} of the presses of the published serpentine.")
    of_readings = [
        f"{each['idle_percent']:.1f} % ({each['label']}, {each['kind']})" for each in idle if each not in model
    ]
    text.append(
        f"By its readings, where a change of at most {100 * ACTIVE:g} % of its range over all presses counts as idle, "
        f"a fibre is idle in {_listed(of_readings)} of the presses: noise beyond that counts as an answer."
    )
    text.append(TABLE_III)
    return text


def _of_recording(rows: Rows) -> str:
    """What is best, and what compensation and denoising each bring to it."""
    best, at_end = (min(rows, key=lambda row: row[key]) for key in ("mean_mm", "mean_last_mm"))
    bare = next(row for row in rows if (row["denoise"], row["compensate"]) == (best["denoise"], "none"))
    alike = [row for row in rows if row["compensate"] == best["compensate"]]
    raw = next(row for row in alike if row["denoise"] == "none")
    filtered = min((row for row in alike if row is not raw), key=lambda row: row["mean_mm"])
    leasts = [
        min((row for row in rows if row["compensate"] == scheme), key=lambda row: row["mean_mm"])
        for scheme in dict.fromkeys(row["compensate"] for row in rows)
    ]
    by_scheme = _listed([f"{row['mean_mm']:.2f} mm ({_scheme(row)})" for row in leasts])
    return (
        f"{best['recording']}, {best['kind']}: presses drawn at random are found best by {_scheme(best)}, "
        f"{best['mean_mm']:.2f} mm off (standard deviation of the networks {best['std_mm']:.2f} mm), and the last ones "
        f"by {_scheme(at_end)}, {at_end['mean_last_mm']:.2f} mm off. Each compensation with the filter that suits it "
        f"best gives {by_scheme}. Denoised as for the best but without compensation, presses are "
        f"{bare['mean_mm']:.2f} mm off, the last ones {bare['mean_last_mm']:.2f} mm, which is "
        f"{bare['mean_mm'] - best['mean_mm']:.2f} mm and {bare['mean_last_mm'] - at_end['mean_last_mm']:.2f} mm more "
        f"than the best. With the best compensation, readings as they are give {raw['mean_mm']:.2f} mm, and the filter "
        f"that suits it best, {filtered['denoise']}, {filtered['mean_mm']:.2f} mm."
    )


def _scheme(row: Mapping[str, Any]) -> str:
    readings = "readings as they are" if row["denoise"] == "none" else f"readings after {row['denoise']}"
    return f"'{row['compensate']}' of {readings}"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


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
    known = {
        **dict.fromkeys(pads, presses),
        **{label: int(own.has_position.sum()) for label, own in recordings.items()},
    }
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


def values(readings: Array, down_command: Indices, up_command: Indices) -> Array:
    """What each fibre reads before, in and after each press, `SETTLED` readings from the probe's commands.

    Where a cycle is too short for that, the nearest reading is taken that belongs neither to the press's other phases
    nor to a neighbouring press.

    Args:
        readings: (R, C) volts. down_command, up_command: (Q,) first reading after the probe was sent down, and up.

    Returns:
        (Q, C, 3) volts.
    """
    return np.stack([readings[at] for at in _places(len(readings), down_command, up_command)], axis=2)


def _places(readings: int, down_command: Indices, up_command: Indices) -> tuple[Indices, Indices, Indices]:
    """(Q,) which readings are those of before, in and after each press."""
    free, following = np.concatenate([[0], up_command[:-1]]), np.concatenate([down_command[1:], [readings]])
    return (
        np.maximum(down_command - SETTLED, free),
        np.minimum(down_command + SETTLED, up_command - 1),
        np.minimum(up_command + SETTLED, following - 1),
    )


def scheme_inputs(name: str, readings: Array, down_command: Indices, up_command: Indices, taught: Indices) -> Array:
    """(Q, D) what a network is given of each press when the drift is taken off as `name`, one of `SCHEMES`, says.

    "windows" are the windows of `compute_features`, of which the principal components are taken that are as many as
    "published" has inputs: else the networks would differ by their size.

    Args:
        readings: (R, C) volts, none missing. down_command, up_command: as `values`.
        taught: presses that the principal components are of.
    """
    if name == "windows":
        windows = compute_features(readings, down_command, up_command, "press_and_release").windows.reshape(
            len(down_command), -1
        )
        middle = windows[taught].mean(axis=0)
        axes = np.linalg.eigh(np.cov(windows[taught], rowvar=False))[1]
        return (windows - middle) @ axes[:, -3 * readings.shape[1] :]
    before, pressed, after = np.moveaxis(values(readings, down_command, up_command), 2, 0)
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
    down_command, up_command, positions_mm = recording.down_command, recording.up_command, recording.presses_mm
    readings = interpolate_gaps(recording.readings)
    FILTERS[name](readings[:2])  # compiled before the clock runs
    clock = perf_counter()
    filtered = FILTERS[name](readings)
    state: State = {"seconds": np.array((perf_counter() - clock) * 1e4 / len(readings))}
    state["idle"] = np.array(recorded_idle_share(replace(recording, readings=filtered)).mean())
    split = _split(np.flatnonzero(recording.has_position), share, seed)
    for number, scheme in enumerate(SCHEMES):
        inputs = scheme_inputs(scheme, filtered, down_command, up_command, split.taught)
        rngs = np.random.default_rng([8, seed]).spawn(MEMBERS)
        check = np.broadcast_to(inputs[split.checked], (MEMBERS, len(split.checked), inputs.shape[1]))
        networks = fit_batch(
            inputs[split.taught], positions_mm[split.taught], rngs, hidden, epochs, (check, positions_mm[split.checked])
        )
        for kind, rows in (("test", split.test), ("last", split.last)):
            found = [distances(network(inputs[rows]), positions_mm[rows]) for network in networks]
            state[f"{kind}_{number}"] = np.stack(found)
    return state | _shown(recording.times_s, readings, filtered, down_command, up_command)


def _shown(times_s: Array, readings: Array, filtered: Array, down_command: Indices, up_command: Indices) -> State:
    """What the figure needs of a recording: see `_tried`."""
    taken = values(filtered, down_command, up_command)
    answers = taken[:, :, 1] - taken[:, :, 0]
    fibre = int(np.argmax(answers.std(axis=0)))
    shown = min(SHOWN, len(down_command))
    first = int(np.argmax(np.convolve(np.abs(answers[:, fibre]), np.ones(shown), "valid")))
    at = np.stack(_places(len(readings), down_command, up_command), axis=1)
    presses = slice(first, first + shown)
    window = slice(max(0, at[first, 0] - SETTLED), at[first + shown - 1, 2] + SETTLED)
    some = np.unique(np.linspace(0, len(down_command) - 1, LEVELS).astype(int))
    return {
        "stretch": np.stack([times_s[window], readings[window, fibre], filtered[window, fibre]]),
        "marks": np.stack([times_s[at[presses]], taken[presses, fibre]], axis=2),
        "levels": np.column_stack([times_s[down_command[some]], taken[some, fibre, :2]]),
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
