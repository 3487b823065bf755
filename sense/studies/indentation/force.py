"""Force: how well the fibres that locate a press also tell how deep, and so how hard, it is."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, FAINT, INK, add_title, style_axes
from padforge.design.indentation import REDUCED_MODULUS_KPA, Indenter, indented_signals
from padforge.design.morphology import Morphology
from padforge.design.networks import fresh_presses
from padforge.design.settings import between_fibres
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.studies.pads import described
from padforge.sense.studies.study import Findings, Study, Task

COUNTS = 2**12 - 1
"""Full scale of the converter the signals are read with."""
SOFT = 4.0
"""Counts below which the logarithm of a reading is bent into a straight line, since there it would be of noise."""
MEMBERS = 3
"""Networks whose mean is taken: when one alone ends its training is luck, which would hide what pads differ by."""
EPOCHS = 200
BINS = 7
"""Depths the error of the place is drawn by."""
COLUMNS = 4
"""Most pads side by side in the figure."""


@dataclass(frozen=True)
class Learning:
    """How many presses are learnt from and tested on, and the neurons of a network and its epochs of training."""

    presses: int = 2048
    test: int = 1024
    hidden: int = 50
    epochs: int = EPOCHS


@dataclass(frozen=True)
class _ForcePresses:
    """How presses are made and read; whether networks are given their depth, and so do not find it."""

    indenter: Indenter
    depths: tuple[float, float]
    depth_told: bool
    noise_counts: float


def force_study(
    pads: Mapping[str, Morphology],
    *,
    indenter: Indenter | None = None,
    depths: tuple[float, float] = (0.1, 0.45),
    noise_counts: Sequence[float] = (1.0, 4.0),
    learning: Learning | None = None,
    seed: int = 0,
) -> Study:
    """Place, depth and force of presses of random depth, from the signals of the indentation model.

    Not knowing the depth is compared with networks that are told it, and with presses of the middle depth alone.

    Args:
        pads: by label. indenter: a sphere of 0.7 grid units if None. depths: least and greatest, grid units.
        noise_counts: standard deviations of the readings' noise, in counts of a 12-bit converter.
        learning: from how many presses, and by what networks; see `Learning`. seed: of presses, noise and networks.

    Raises:
        InputError: depths the indenter does not allow.
    """
    indenter, learning = indenter or Indenter(), learning or Learning()
    indenter.contact_radius(depths)
    middle = float(np.mean(depths))
    cases = (("depth unknown", depths, False), ("depth told", depths, True), ("one depth", (middle, middle), False))
    tasks = [
        Task(
            f"{label}, noise of {_counts(noise)}, {name}",
            partial(_found, pad, _ForcePresses(indenter, each, told, noise), learning, seed),
        )
        for label, pad in pads.items()
        for noise in noise_counts
        for name, each, told in cases
    ]
    settings = {
        "pads": described(pads),
        "indenter": {"shape": indenter.shape, "radius": indenter.radius, "angle_deg": indenter.angle_deg},
        "depths": list(depths),
        "noise_counts": list(noise_counts),
        "reduced_modulus_kpa": REDUCED_MODULUS_KPA,
        "presses": learning.presses,
        "test": learning.test,
        "members": MEMBERS,
        "hidden": learning.hidden,
        "epochs": learning.epochs,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), indenter, settings)
    return Study("force", "Depth and force of a press, besides its place", settings, tasks, conclude, _draw)


def readings(signals: Array, full: Array, noise_counts: float, rng: np.random.Generator) -> Array:
    """What a 12-bit converter reads: whole counts of (Q, C) signals with noise, 0 and full scale `full` (C,) at most.

    A fibre without a full scale was never stretched, and reads its noise.
    """
    share = np.divide(signals, full, out=np.zeros(signals.shape), where=full > 0)
    return np.clip(np.rint(COUNTS * share + rng.normal(0, noise_counts, signals.shape)), 0, COUNTS)


def magnitudes(read: Array) -> Array:
    """Logarithms of readings (Q, C) in counts: a deeper press multiplies all signals, and so adds to these."""
    return np.log1p(read / SOFT)


def committee(
    inputs: Array, targets: Array, rng: np.random.Generator, hidden: int, epochs: int
) -> Callable[[Array], Array]:
    """The mean of networks that learnt from (Q, D) inputs and (Q, O) targets, each with its own split and weights."""
    from padforge.design.networks import fit_batch

    members = fit_batch(inputs, targets, rng.spawn(MEMBERS), hidden, epochs)
    return lambda given: np.mean([network(given) for network in members], axis=0)


def _found(pad: Morphology, made: _ForcePresses, learning: Learning, seed: int) -> State:
    """The test presses as they were made, "pressed", and as networks find them, "found": (T, 3) x, y, depth.

    The full scale of a fibre is the greatest signal it gave in the presses that were learnt from.
    """
    rng = np.random.default_rng([3, seed])
    presses, count = learning.presses, learning.presses + learning.test
    places = fresh_presses(between_fibres(pad.layout), count, int(rng.integers(2**32)))
    deep = rng.uniform(*made.depths, count)
    signals = indented_signals(pad, places, deep, made.indenter)
    given = magnitudes(readings(signals, signals[:presses].max(axis=0), made.noise_counts, rng))
    targets = np.column_stack([places, deep])
    if made.depth_told:
        given, targets = np.column_stack([given, deep]), places
    locate = committee(given[:presses], targets[:presses], rng, learning.hidden, learning.epochs)
    return {"pressed": targets[presses:], "found": locate(given[presses:])}


def _counts(number: float) -> str:
    return f"{number:g} count" if number == 1 else f"{number:g} counts"


def _conclude(
    pads: Mapping[str, Morphology], indenter: Indenter, settings: Mapping[str, Any], states: list[State]
) -> Findings:
    low, high = settings["depths"]
    edges = np.linspace(low, high, BINS + 1)
    rows, curves = [], []
    results = iter(states)
    for label, pad in pads.items():
        for noise in settings["noise_counts"]:
            unknown, told, fixed = next(results), next(results), next(results)
            deep, found = unknown["pressed"][:, 2], np.clip(unknown["found"][:, 2], low, high)
            off = _distances(unknown)
            force = partial(indenter.force_n, unit_mm=pad.unit_mm)
            span = float(force(high) - force(low))
            rows.append(
                {
                    "pad": label,
                    "noise_counts": noise,
                    "place_grid": float(off.mean()),
                    "place_mm": float(off.mean() * pad.unit_mm),
                    "place_depth_told_mm": float(_distances(told).mean() * pad.unit_mm),
                    "place_one_depth_mm": float(_distances(fixed).mean() * pad.unit_mm),
                    "depth_grid": float(np.abs(found - deep).mean()),
                    "depth_mm": float(np.abs(found - deep).mean() * pad.unit_mm),
                    "depth_guessed_mm": float(np.abs(deep - (low + high) / 2).mean() * pad.unit_mm),
                    "force_n": float(np.abs(force(found) - force(deep)).mean()),
                    "force_percent": float(100 * np.abs(force(found) - force(deep)).mean() / span),
                    "force_guessed_percent": float(100 * np.abs(force((low + high) / 2) - force(deep)).mean() / span),
                }
            )
            own = np.digitize(deep, edges[1:-1])
            curves.append(
                {
                    "pad": label,
                    "noise_counts": noise,
                    "pressed_mm": np.round(deep * pad.unit_mm, 4).tolist(),
                    "found_mm": np.round(found * pad.unit_mm, 4).tolist(),
                    "middles_mm": ((edges[1:] + edges[:-1]) / 2 * pad.unit_mm).tolist(),
                    "place_mm": [
                        float(off[own == bin].mean() * pad.unit_mm) if (own == bin).any() else None
                        for bin in range(BINS)
                    ],
                }
            )
    return Findings(rows, _told(indenter, settings, rows), {"curves": curves})


def _distances(state: State) -> Array:
    """(T,) how far from the place pressed the place found lies, grid units."""
    return np.linalg.norm(state["found"][:, :2] - state["pressed"][:, :2], axis=1)


def _told(indenter: Indenter, settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    low, high = settings["depths"]
    form = f"cone of {indenter.angle_deg:g} degrees" if indenter.shape == "cone" else indenter.shape
    size = "" if indenter.shape == "cone" else f" of radius {indenter.radius:g} grid units"
    noises = " or ".join(f"{noise:g}" for noise in settings["noise_counts"])
    text = [
        f"A rigid {form}{size} is pressed {low:g} to {high:g} grid units deep at random places. A fibre signals by how "
        "much the deflected surface lengthens it, read by a 12-bit converter whose full scale is the fibre's greatest "
        f"signal, with noise of {noises} counts. Networks of {settings['hidden']} neurons, of which the mean of "
        f"{settings['members']} is taken, give x, y and depth from the readings' logarithms; they learnt from "
        f"{settings['presses']} presses and were tested on {settings['test']} others."
    ]
    for row in rows:
        text.append(
            f"{row['pad']}, noise of {_counts(row['noise_counts'])}: the depth is found {row['depth_mm']:.2f} mm off "
            f"(guessing the middle depth: {row['depth_guessed_mm']:.2f} mm), the force {row['force_n']:.3f} N or "
            f"{row['force_percent']:.1f} % of its range (guessing: {row['force_guessed_percent']:.1f} %). The place is "
            f"found {row['place_mm']:.2f} mm off, {row['place_depth_told_mm']:.2f} mm by networks that are told the "
            f"depth, and {row['place_one_depth_mm']:.2f} mm where all presses are {(low + high) / 2:g} grid units deep."
        )
    text.append(
        "Depth and force belong together by the contact mechanics of an elastic half-space of reduced modulus "
        f"{settings['reduced_modulus_kpa']:.0f} kPa. A pad a few millimetres thick on a hard table is stiffer than "
        "that, and silicone creeps: forces of a built pad want a calibration against a load cell."
    )
    return text


def _draw(document: Mapping[str, Any]) -> Figure:
    """Depth found against depth pressed for every pad, and the error of the place by depth."""
    curves, noises = document["curves"], document["settings"]["noise_counts"]
    labels = list(document["settings"]["pads"])
    columns = min(len(labels), COLUMNS)
    rows = -(-len(labels) // columns)
    figure = Figure(figsize=(max(6.4, 2.9 * columns), 3.1 * rows + 3.4), layout="constrained")
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[1.0] * rows + [1.05])
    for at, label in enumerate(labels):
        axes = figure.add_subplot(grid[at // columns, at % columns], aspect="equal")
        own = [curve for curve in curves if curve["pad"] == label]
        for curve, colour in reversed(list(zip(own, CURVES[2::-1], strict=False))):
            name = f"noise {curve['noise_counts']:g}"
            axes.scatter(curve["pressed_mm"], curve["found_mm"], s=3, color=colour, alpha=0.5, linewidths=0, label=name)
        ends = [min(own[0]["pressed_mm"]), max(own[0]["pressed_mm"])]
        axes.plot(ends, ends, color=INK, linewidth=0.8)
        axes.set_title(label, loc="left", color=INK, fontsize=10)
        axes.set(xlabel="depth pressed (mm)", ylabel="depth found (mm)" if at % columns == 0 else "")
        axes.legend(frameon=False, fontsize=8, markerscale=3, handletextpad=0.1)
        style_axes(axes)
    axes = figure.add_subplot(grid[rows, :])
    for curve in curves:
        colour = CURVES[labels.index(curve["pad"]) % len(CURVES)]
        style = ("-", "--", ":", "-.")[noises.index(curve["noise_counts"]) % 4]
        name = f"{curve['pad']}, noise {curve['noise_counts']:g}"
        errors = [np.nan if error is None else error for error in curve["place_mm"]]
        axes.plot(curve["middles_mm"], errors, style, color=colour, marker="o", markersize=3.5, label=name)
    axes.set(ylim=(0, None), xlabel="depth pressed (mm)", ylabel="mean error of the place (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    figure.legend(*axes.get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside lower left", ncols=columns)
    style_axes(axes)
    add_title(figure, f"Depth of {document['settings']['test']} presses never trained on; noise in counts of 12 bits")
    return figure
