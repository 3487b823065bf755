"""Force: how well the fibres that locate a press also tell how deep, and so how hard, it is.

Shape: whether the fibres that locate a press also tell which object was pressed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, FAINT, INK, add_title, draw_confusions, style_axes
from padforge.design.contact import signals
from padforge.design.indentation import REDUCED_MODULUS_KPA, Indenter, indented_signals
from padforge.design.morphology import Morphology
from padforge.design.networks import fresh_presses
from padforge.design.settings import Contact, between_fibres
from padforge.sense.arrays import Array, Indices
from padforge.sense.studies.study import Findings, Study, Task, described

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
                    "predicted_mm": np.round(found * pad.unit_mm, 4).tolist(),
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
            axes.scatter(
                curve["pressed_mm"], curve["predicted_mm"], s=3, color=colour, alpha=0.5, linewidths=0, label=name
            )
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


INDENTERS = {
    "sphere": Indenter("sphere", radius=0.7),
    "cone": Indenter("cone", angle_deg=22),
    "flat punch": Indenter("flat", radius=0.44),
}
"""Of about the same contact radius at the middle depth, 0.44 grid units, so that profiles are told apart, not sizes."""
DEPTHS = (0.1, 0.45)
FOOTPRINTS = {"circle": None, "square": 4, "triangle": 3}
"""Sides of each, a circle's None."""
SIZES = np.linspace(0.5, 0.9, 17)
"""Radii of circles of the same area as a footprint, grid units; one is drawn for every press."""
NOISE_COUNTS = 1.0
SETS = {"indenters": tuple(INDENTERS), "footprints": tuple(FOOTPRINTS)}


def shape_study(
    pads: Mapping[str, Morphology],
    *,
    presses: int = 4096,
    test: int = 2048,
    hidden: int = 50,
    epochs: int = EPOCHS,
    seed: int = 0,
) -> Study:
    """Which object was pressed, of indenters of unknown depth and of footprints of unknown size, place unknown too.

    Indenters follow the indentation model, footprints the published contact model: polygons of one orientation.

    Args:
        pads: by label. presses, test: how many are learnt from and tested on, over all shapes of a set.
        hidden, epochs: of a network. seed: of presses, noise and networks.
    """
    tasks = [
        Task(f"{label}, {of}, {name}", partial(work, _ShapePresses(pad, of, presses, test, seed), hidden, epochs))
        for label, pad in pads.items()
        for of in SETS
        for name, work in (("shape", _classified), ("place", _located))
    ]
    settings = {
        "pads": described(pads),
        "depths": list(DEPTHS),
        "sizes": [float(SIZES[0]), float(SIZES[-1])],
        "noise_counts": NOISE_COUNTS,
        "presses": presses,
        "test": test,
        "members": MEMBERS,
        "hidden": hidden,
        "epochs": epochs,
        "seed": seed,
    }
    return Study(
        "shape",
        "Shape of what is pressed",
        settings,
        tasks,
        partial(_conclude_shape, dict(pads), settings),
        _draw_shape,
    )


@dataclass(frozen=True)
class _ShapePresses:
    """Presses of a set of shapes on a pad, the last `test` of them to test on.

    Attributes:
        of: which of SETS. learnt: how many presses to learn from.
    """

    pad: Morphology
    of: str
    learnt: int
    test: int
    seed: int

    def made(self) -> tuple[Array, Array, Indices, np.random.Generator]:
        """What a network is given (Q, C), places (Q, 2), the shape's index (Q,), and what to draw further from."""
        rng = np.random.default_rng([4, self.seed, list(SETS).index(self.of)])
        count = self.learnt + self.test
        places = fresh_presses(between_fibres(self.pad.layout), count, int(rng.integers(2**32)))
        shape = rng.integers(len(SETS[self.of]), size=count)
        if self.of == "indenters":
            given = _indented(self.pad, places, shape, rng.uniform(*DEPTHS, count))
        else:
            given = _printed(self.pad, places, shape, rng.integers(len(SIZES), size=count))
        read = readings(given, given[: self.learnt].max(axis=0), NOISE_COUNTS, rng)
        return magnitudes(read) if self.of == "indenters" else read, places, shape, rng


def _indented(pad: Morphology, places: Array, shape: Indices, depths: Array) -> Array:
    """(Q, C) signals of indenters."""
    given = np.empty((len(places), pad.layout.fibres))
    for index, indenter in enumerate(INDENTERS.values()):
        own = shape == index
        given[own] = indented_signals(pad, places[own], depths[own], indenter)
    return given


def _printed(pad: Morphology, places: Array, shape: Indices, size: Indices) -> Array:
    """(Q, C) signals of footprints, of SIZES[size]."""
    given = np.empty((len(places), pad.layout.fibres))
    for index, sides in enumerate(FOOTPRINTS.values()):
        for each, radius in enumerate(SIZES):
            own = (shape == index) & (size == each)
            given[own] = signals(pad, places[own], Contact(radius=radius * circumradius(sides), sides=sides))
    return given


def circumradius(sides: int | None) -> float:
    """Of a regular polygon that has the area of a circle of radius 1."""
    return 1.0 if sides is None else float(np.sqrt(2 * np.pi / (sides * np.sin(2 * np.pi / sides))))


def _classified(presses: _ShapePresses, hidden: int, epochs: int) -> State:
    """Confusions (K, K) on the test presses: how often shape i, by row, was taken for j."""
    given, _, shape, rng = presses.made()
    count = len(SETS[presses.of])
    name = committee(given[: presses.learnt], np.eye(count)[shape[: presses.learnt]], rng, hidden, epochs)
    confusions = np.zeros((count, count), dtype=np.int64)
    np.add.at(confusions, (shape[presses.learnt :], name(given[presses.learnt :]).argmax(axis=1)), 1)
    return {"confusions": confusions}


def _located(presses: _ShapePresses, hidden: int, epochs: int) -> State:
    """Mean error of the place on the test presses, grid units: "unknown", and "known" to networks told the shape."""
    given, places, shape, rng = presses.made()
    told = np.column_stack([given, np.eye(len(SETS[presses.of]))[shape]])
    errors = {}
    for name, inputs, draw in zip(("unknown", "known"), (given, told), rng.spawn(2), strict=True):
        locate = committee(inputs[: presses.learnt], places[: presses.learnt], draw, hidden, epochs)
        off = locate(inputs[presses.learnt :]) - places[presses.learnt :]
        errors[name] = np.linalg.norm(off, axis=1).mean()
    return errors


def _conclude_shape(pads: Mapping[str, Morphology], settings: Mapping[str, Any], states: list[State]) -> Findings:
    rows, confusions = [], []
    results = iter(states)
    for label, pad in pads.items():
        for of, shapes in SETS.items():
            counts, errors = next(results)["confusions"], next(results)
            share = np.diag(counts) / np.maximum(counts.sum(axis=1), 1)
            worst = int(np.argmin(share))
            rows.append(
                {
                    "pad": label,
                    "shapes": of,
                    "accuracy_percent": float(100 * np.trace(counts) / counts.sum()),
                    "guessed_percent": float(100 * counts.sum(axis=1).max() / counts.sum()),
                    "worst": shapes[worst],
                    "worst_percent": float(100 * share[worst]),
                    "place_mm": float(errors["unknown"] * pad.unit_mm),
                    "place_shape_known_mm": float(errors["known"] * pad.unit_mm),
                }
            )
            confusions.append({"pad": label, "shapes": of, "names": list(shapes), "counts": counts.tolist()})
    return Findings(rows, _told_shape(settings, rows), {"confusions": confusions})


def _told_shape(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    sphere, cone, flat = INDENTERS.values()
    text = [
        f"Indenters: a sphere of radius {sphere.radius:g}, a cone whose flank makes {cone.angle_deg:g} degrees with "
        f"the surface, and a flat punch of radius {flat.radius:g} grid units, pressed {DEPTHS[0]:g} to {DEPTHS[1]:g} "
        "deep into an elastic half-space. Footprints: circle, square and triangle of equal area, that of a circle of "
        f"{SIZES[0]:g} to {SIZES[-1]:g} grid units radius, always turned the same way, under the published contact "
        f"model. Readings are whole counts of 12 bits with noise of {NOISE_COUNTS:g}. Place, depth and size are drawn "
        f"afresh for every press; networks of {settings['hidden']} neurons, of which the mean of "
        f"{settings['members']} is taken, learnt from {settings['presses']} presses of a set and were tested on "
        f"{settings['test']} others."
    ]
    for row in rows:
        text.append(
            f"{row['pad']}, {row['shapes']}: {row['accuracy_percent']:.1f} % are named rightly (always naming the most "
            f"frequent: {row['guessed_percent']:.1f} %), worst the {row['worst']} with {row['worst_percent']:.1f} %. "
            f"The place is found {row['place_mm']:.2f} mm off; networks that are told the shape find it "
            f"{row['place_shape_known_mm']:.2f} mm off."
        )
    ratios = [row["place_mm"] / row["place_shape_known_mm"] for row in rows]
    luck = ", where below 1 is the luck of training" if min(ratios) < 1 else ""
    text.append(
        f"Not knowing the shape makes the error of the place {min(ratios):.2f} to {max(ratios):.2f} times as much"
        f"{luck}."
    )
    return text


def _draw_shape(document: Mapping[str, Any]) -> Figure:
    """The confusion matrices: a column for every pad, a row for every set of shapes, in per cent of each true shape."""
    labels = list(document["settings"]["pads"])
    figure = Figure(figsize=(max(6.4, 1.2 + 2.7 * len(labels)), 6.2), layout="constrained")
    grid = figure.subplots(len(SETS), len(labels), squeeze=False)
    for each, row in zip(document["confusions"], document["rows"], strict=True):
        at, column = list(SETS).index(each["shapes"]), labels.index(each["pad"])
        axes, names = grid[at, column], each["names"]
        draw_confusions(axes, each["counts"])
        axes.set_xticks(range(len(names)), names, fontsize=8, color=INK)
        shown = names if column == 0 else [""] * len(names)
        axes.set_yticks(range(len(names)), shown, fontsize=8, color=INK, rotation=90, va="center")
        axes.set_title(f"{each['pad']}: {row['accuracy_percent']:.0f} %", loc="left", color=INK, fontsize=10)
        if column == 0:
            axes.set_ylabel("pressed", color=INK)
        axes.set_xlabel("found" if at == len(SETS) - 1 else "", color=INK)
    add_title(figure, f"Which object was pressed, per cent of {document['settings']['test']} presses never trained on")
    return figure
