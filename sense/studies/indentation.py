"""Force and shape: whether the fibres that localize a press also tell how deep and hard it is, and with what object."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, INK, add_title, draw_confusions
from padforge.design.contact import signals
from padforge.design.indentation import REDUCED_MODULUS_KPA, Indenter, indented_signals
from padforge.design.morphology import Morphology
from padforge.design.networks import fresh_presses
from padforge.design.settings import Contact, between_fibres
from padforge.sense.arrays import Array, Indices
from padforge.sense.studies.study import (
    MEMBERS,
    Study,
    StudyResult,
    Task,
    classification_scores,
    confusion_matrix,
    describe_pads,
    fit_ensemble,
    label_axes,
    quantize,
)

LOG_SCALE = 4.0
"""Counts below which the logarithm of a reading becomes linear, since there it would be one of noise. To logarithms a
deeper press adds, as it multiplies all signals."""
DEPTHS = (0.1, 0.45)  # least and greatest, grid units
BINS = 7  # depths by which the error of the position is drawn
COLUMNS = 4  # pads side by side in the figure of the force
INDENTERS = {
    "sphere": Indenter("sphere", radius=0.7),
    "cone": Indenter("cone", angle_deg=22),
    "flat punch": Indenter("flat", radius=0.44),
}
"""Of about the same contact radius at the middle depth, 0.44 grid units, so that they differ by profile alone."""
FOOTPRINTS = {"circle": None, "square": 4, "triangle": 3}  # sides of each polygon; None for a circle
SIZES = np.linspace(0.5, 0.9, 17)
"""Radii of circles of the same area as a footprint, grid units; one is drawn for every press."""
SHAPE_NOISE_COUNTS = 1.0
SETS = {"indenters": tuple(INDENTERS), "footprints": tuple(FOOTPRINTS)}


def force_study(
    pads: Mapping[str, Morphology],
    *,
    indenter: Indenter | None = None,
    depths: tuple[float, float] = DEPTHS,
    noise_counts: Sequence[float] = (1.0, 4.0),
    presses: int = 2048,
    test: int = 1024,
    hidden: int = 50,
    epochs: int = 200,
    seed: int = 0,
) -> Study:
    """Estimate position, depth and force of presses of random depth, from the signals of the indentation model.

    An unknown depth is compared with one that is an input, and with presses of the middle depth alone.

    Args:
        pads: by label.
        indenter: a sphere of 0.7 grid units if None.
        depths: least and greatest, grid units.
        noise_counts: standard deviations of the readings' noise, in counts of a 12-bit converter.
        presses: training presses.
        test: test presses.
        hidden: neurons of a network.
        epochs: of training.
        seed: of presses, noise and networks.

    Raises:
        InputError: depths that the indenter does not allow.
    """
    indenter = indenter or Indenter()
    indenter.contact_radius(depths)
    middle = float(np.mean(depths))
    cases = (("depth unknown", depths, False), ("depth known", depths, True), ("one depth", (middle, middle), False))
    numbers = {"presses": presses, "test": test, "hidden": hidden, "epochs": epochs, "seed": seed}
    tasks = [
        Task(
            f"{label}, noise of {_counts(noise)}, {name}",
            partial(_estimate_depth, pad, indenter, case_depths, is_known, noise, **numbers),
        )
        for label, pad in pads.items()
        for noise in noise_counts
        for name, case_depths, is_known in cases
    ]
    settings = {
        "pads": describe_pads(pads),
        "indenter": {"shape": indenter.shape, "radius": indenter.radius, "angle_deg": indenter.angle_deg},
        "depths": list(depths),
        "noise_counts": list(noise_counts),
        "reduced_modulus_kpa": REDUCED_MODULUS_KPA,
        "members": MEMBERS,
        **numbers,
    }
    conclude = partial(_conclude_force, dict(pads), indenter, settings)
    return Study("force", "Depth and force of a press, besides its position", settings, tasks, conclude, _draw_force)


def _estimate_depth(
    pad: Morphology,
    indenter: Indenter,
    depths: tuple[float, float],
    is_known: bool,
    noise_counts: float,
    *,
    presses: int,
    test: int,
    hidden: int,
    epochs: int,
    seed: int,
) -> State:
    """Return x, y and depth of the test presses, "pressed" and "predicted", grid units; no depth where it is known."""
    rng = np.random.default_rng([3, seed])
    positions = fresh_presses(between_fibres(pad.layout), presses + test, int(rng.integers(2**32)))
    depth = rng.uniform(*depths, presses + test)
    responses = indented_signals(pad, positions, depth, indenter)
    inputs = np.log1p(quantize(responses, responses[:presses].max(axis=0), noise_counts, rng) / LOG_SCALE)
    targets = np.column_stack([positions, depth])
    if is_known:
        inputs, targets = np.column_stack([inputs, depth]), positions
    predict = fit_ensemble(inputs[:presses], targets[:presses], rng, hidden, epochs)
    return {"pressed": targets[presses:], "predicted": predict(inputs[presses:])}


def _counts(number: float) -> str:
    return f"{number:g} count" if number == 1 else f"{number:g} counts"


def _conclude_force(
    pads: Mapping[str, Morphology], indenter: Indenter, settings: Mapping[str, Any], states: list[State]
) -> StudyResult:
    low, high = settings["depths"]
    middle = (low + high) / 2
    edges = np.linspace(low, high, BINS + 1)
    rows, curves = [], []
    results = iter(states)
    for label, pad in pads.items():
        unit_mm, force_n = pad.unit_mm, partial(indenter.force_n, unit_mm=pad.unit_mm)
        force_range_n = float(force_n(high) - force_n(low))
        for noise in settings["noise_counts"]:
            cases = [next(results) for _ in range(3)]
            depth, predicted = cases[0]["pressed"][:, 2], np.clip(cases[0]["predicted"][:, 2], low, high)
            errors, *others = (
                np.linalg.norm(case["predicted"][:, :2] - case["pressed"][:, :2], axis=1) for case in cases
            )
            depth_known_mm, one_depth_mm = (float(case_errors.mean() * unit_mm) for case_errors in others)
            force_guess_n = float(np.abs(force_n(middle) - force_n(depth)).mean())
            force_error_n = float(np.abs(force_n(predicted) - force_n(depth)).mean())
            row = {
                "pad": label,
                "noise_counts": noise,
                "position_grid": float(errors.mean()),
                "position_mm": float(errors.mean() * unit_mm),
                "position_depth_known_mm": depth_known_mm,
                "position_one_depth_mm": one_depth_mm,
                "depth_grid": float(np.abs(predicted - depth).mean()),
                "depth_mm": float(np.abs(predicted - depth).mean() * unit_mm),
                "depth_guessed_mm": float(np.abs(depth - middle).mean() * unit_mm),
                "force_n": force_error_n,
                "force_percent": 100 * force_error_n / force_range_n,
                "force_guessed_percent": 100 * force_guess_n / force_range_n,
            }
            rows.append(row)
            bins = np.digitize(depth, edges[1:-1])
            means = [errors[bins == bin].mean() * unit_mm if (bins == bin).any() else None for bin in range(BINS)]
            curves.append(
                {
                    "pad": label,
                    "noise_counts": noise,
                    "pressed_mm": np.round(depth * unit_mm, 4).tolist(),
                    "predicted_mm": np.round(predicted * unit_mm, 4).tolist(),
                    "bin_depth_mm": ((edges[1:] + edges[:-1]) / 2 * unit_mm).tolist(),
                    "bin_position_mm": [None if mean is None else float(mean) for mean in means],
                }
            )
    return StudyResult(rows, _describe_force(indenter, settings, rows), {"curves": curves})


def _describe_force(indenter: Indenter, settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    low, high = settings["depths"]
    form = f"cone of {indenter.angle_deg:g} degrees" if indenter.shape == "cone" else indenter.shape
    size = "" if indenter.shape == "cone" else f" of radius {indenter.radius:g} grid units"
    noises = " or ".join(f"{noise:g}" for noise in settings["noise_counts"])
    text = [
        f"A rigid {form}{size} is pressed {low:g} to {high:g} grid units deep at random positions. The signal of a "
        "fibre is its lengthening by the deflected surface, read by a 12-bit converter whose full scale is the fibre's "
        f"largest signal, with noise of {noises} counts. Networks of {settings['hidden']} neurons, of which the mean "
        f"of {settings['members']} is taken, estimate x, y and depth from the readings' logarithms; they were trained "
        f"on {settings['presses']} presses and tested on {settings['test']} others."
    ]
    for row in rows:
        text.append(
            f"{row['pad']}, noise of {_counts(row['noise_counts'])}: the error of the depth is {row['depth_mm']:.2f} "
            f"mm (guessing the middle depth: {row['depth_guessed_mm']:.2f} mm), of the force {row['force_n']:.3f} N or "
            f"{row['force_percent']:.1f} % of its range (guessing: {row['force_guessed_percent']:.1f} %). That of the "
            f"position is {row['position_mm']:.2f} mm, {row['position_depth_known_mm']:.2f} mm where the depth is an "
            f"input, and {row['position_one_depth_mm']:.2f} mm where all presses are {(low + high) / 2:g} grid units "
            "deep."
        )
    text.append(
        "Depth and force are related by the contact mechanics of an elastic half-space of reduced modulus "
        f"{settings['reduced_modulus_kpa']:.0f} kPa. A pad a few millimetres thick on a hard table is stiffer than "
        "that, and silicone creeps: forces of a built pad need a calibration against a load cell."
    )
    return text


def _draw_force(document: Mapping[str, Any]) -> Figure:
    """Draw predicted against true depth for every pad, and the error of the position by depth."""
    curves, noises = document["curves"], document["settings"]["noise_counts"]
    labels = list(document["settings"]["pads"])
    columns = min(len(labels), COLUMNS)
    rows = -(-len(labels) // columns)
    figure = Figure(figsize=(max(6.4, 2.9 * columns), 3.1 * rows + 3.4), layout="constrained")
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[1.0] * rows + [1.05])
    for number, label in enumerate(labels):
        row, column = divmod(number, columns)
        axes = figure.add_subplot(grid[row, column], aspect="equal")
        by_noise = [curve for curve in curves if curve["pad"] == label]
        for curve, colour in reversed(list(zip(by_noise, CURVES[2::-1], strict=False))):
            dots = {"s": 3, "color": colour, "alpha": 0.5, "linewidths": 0}
            axes.scatter(curve["pressed_mm"], curve["predicted_mm"], label=f"noise {curve['noise_counts']:g}", **dots)
        ends = [min(by_noise[0]["pressed_mm"]), max(by_noise[0]["pressed_mm"])]
        axes.plot(ends, ends, color=INK, linewidth=0.8)
        label_axes(axes, label, xlabel="true depth (mm)", ylabel="" if column else "predicted depth (mm)")
        axes.legend(frameon=False, fontsize=8, markerscale=3, handletextpad=0.1)
    axes = figure.add_subplot(grid[rows, :])
    for curve in curves:
        colour = CURVES[labels.index(curve["pad"]) % len(CURVES)]
        style = ("-", "--", ":", "-.")[noises.index(curve["noise_counts"]) % 4]
        name = f"{curve['pad']}, noise {curve['noise_counts']:g}"
        errors = [np.nan if error is None else error for error in curve["bin_position_mm"]]
        axes.plot(curve["bin_depth_mm"], errors, style, color=colour, marker="o", markersize=3.5, label=name)
    label_axes(axes, grid="y", ylim=(0, None), xlabel="true depth (mm)", ylabel="mean error of the position (mm)")
    figure.legend(*axes.get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside lower left", ncols=columns)
    add_title(figure, f"Depth of {document['settings']['test']} presses never trained on; noise in counts of 12 bits")
    return figure


def shape_study(
    pads: Mapping[str, Morphology],
    *,
    presses: int = 4096,
    test: int = 2048,
    hidden: int = 50,
    epochs: int = 200,
    seed: int = 0,
) -> Study:
    """Classify the object: indenters of unknown depth, and footprints of unknown size, the position unknown too.

    Indenters follow the indentation model, footprints the published contact: polygons of one orientation.
    Arguments are as of `force_study`.
    """
    tasks = [
        Task(f"{label}, {kind}, {name}", partial(work, pad, kind, presses, test, hidden, epochs, seed))
        for label, pad in pads.items()
        for kind in SETS
        for name, work in (("shape", _classify), ("position", _localize))
    ]
    settings = {
        "pads": describe_pads(pads),
        "depths": list(DEPTHS),
        "sizes": [float(SIZES[0]), float(SIZES[-1])],
        "noise_counts": SHAPE_NOISE_COUNTS,
        "presses": presses,
        "test": test,
        "members": MEMBERS,
        "hidden": hidden,
        "epochs": epochs,
        "seed": seed,
    }
    conclude = partial(_conclude_shape, dict(pads), settings)
    return Study("shape", "Shape of what is pressed", settings, tasks, conclude, _draw_shape)


def _simulate_shapes(
    pad: Morphology, kind: str, training: int, test: int, seed: int
) -> tuple[Array, Array, Indices, np.random.Generator]:
    """Return network inputs (Q, C), positions (Q, 2), indices of the shapes (Q,), and the generator to go on with."""
    rng, count = np.random.default_rng([4, seed, list(SETS).index(kind)]), training + test
    positions = fresh_presses(between_fibres(pad.layout), count, int(rng.integers(2**32)))
    shape = rng.integers(len(SETS[kind]), size=count)
    responses = np.empty((count, pad.layout.fibres))
    if kind == "indenters":
        depths = rng.uniform(*DEPTHS, count)
        for index, indenter in enumerate(INDENTERS.values()):
            rows = shape == index
            responses[rows] = indented_signals(pad, positions[rows], depths[rows], indenter)
    else:
        size = rng.integers(len(SIZES), size=count)
        for (index, sides), (size_index, radius) in product(enumerate(FOOTPRINTS.values()), enumerate(SIZES)):
            rows = (shape == index) & (size == size_index)
            contact = Contact(radius=radius * circumradius(sides), sides=sides)
            responses[rows] = signals(pad, positions[rows], contact)
    counts = quantize(responses, responses[:training].max(axis=0), SHAPE_NOISE_COUNTS, rng)
    return np.log1p(counts / LOG_SCALE) if kind == "indenters" else counts, positions, shape, rng


def circumradius(sides: int | None) -> float:
    """Return the circumradius of a regular polygon with the area of a circle of radius 1."""
    return 1.0 if sides is None else float(np.sqrt(2 * np.pi / (sides * np.sin(2 * np.pi / sides))))


def _classify(pad: Morphology, kind: str, training: int, test: int, hidden: int, epochs: int, seed: int) -> State:
    """Return the confusions (K, K) of shapes on the test presses."""
    inputs, _, shape, rng = _simulate_shapes(pad, kind, training, test, seed)
    classes = len(SETS[kind])
    classify = fit_ensemble(inputs[:training], np.eye(classes)[shape[:training]], rng, hidden, epochs)
    return confusion_matrix(shape[training:], classify(inputs[training:]).argmax(axis=1), classes)


def _localize(pad: Morphology, kind: str, training: int, test: int, hidden: int, epochs: int, seed: int) -> State:
    """Return mean errors of the position on the test presses, grid units: shape "unknown", or "known" as an input."""
    inputs, positions, shape, rng = _simulate_shapes(pad, kind, training, test, seed)
    with_shape = np.column_stack([inputs, np.eye(len(SETS[kind]))[shape]])
    errors = {}
    for name, features, member_rng in zip(("unknown", "known"), (inputs, with_shape), rng.spawn(2), strict=True):
        predict = fit_ensemble(features[:training], positions[:training], member_rng, hidden, epochs)
        errors[name] = np.linalg.norm(predict(features[training:]) - positions[training:], axis=1).mean()
    return errors


def _conclude_shape(pads: Mapping[str, Morphology], settings: Mapping[str, Any], states: list[State]) -> StudyResult:
    rows, confusions = [], []
    results = iter(states)
    for label, pad in pads.items():
        for kind, shapes in SETS.items():
            counts, errors = next(results)["confusions"], next(results)
            recall = np.diag(counts) / np.maximum(counts.sum(axis=1), 1)
            worst = int(np.argmin(recall))
            row = {
                "pad": label,
                "shapes": kind,
                **classification_scores(counts),
                "worst": shapes[worst],
                "worst_percent": float(100 * recall[worst]),
                "position_mm": float(errors["unknown"] * pad.unit_mm),
                "position_shape_known_mm": float(errors["known"] * pad.unit_mm),
            }
            rows.append(row)
            confusions.append({"pad": label, "shapes": kind, "names": list(shapes), "counts": counts.tolist()})
    return StudyResult(rows, _describe_shape(settings, rows), {"confusions": confusions})


def _describe_shape(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    sphere, cone, flat = INDENTERS.values()
    text = [
        f"Indenters: a sphere of radius {sphere.radius:g}, a cone whose flank makes {cone.angle_deg:g} degrees with "
        f"the surface, and a flat punch of radius {flat.radius:g} grid units, pressed {DEPTHS[0]:g} to {DEPTHS[1]:g} "
        "deep into an elastic half-space. Footprints: circle, square and triangle of equal area, that of a circle of "
        f"{SIZES[0]:g} to {SIZES[-1]:g} grid units radius, of one orientation, under the published contact model. "
        f"Readings are whole counts of 12 bits with noise of {SHAPE_NOISE_COUNTS:g}. Position, depth and size are "
        f"drawn for every press; networks of {settings['hidden']} neurons, of which the mean of {settings['members']} "
        f"is taken, were trained on {settings['presses']} presses of a set and tested on {settings['test']} others."
    ]
    for row in rows:
        text.append(
            f"{row['pad']}, {row['shapes']}: {row['accuracy_percent']:.1f} % are classified correctly (always the most "
            f"frequent: {row['majority_percent']:.1f} %), worst the {row['worst']} with {row['worst_percent']:.1f} %. "
            f"The error of the position is {row['position_mm']:.2f} mm, and {row['position_shape_known_mm']:.2f} mm by "
            "networks with the shape as an input."
        )
    ratios = [row["position_mm"] / row["position_shape_known_mm"] for row in rows]
    chance = ", where below 1 is chance in training" if min(ratios) < 1 else ""
    text.append(
        f"An unknown shape makes the error of the position {min(ratios):.2f} to {max(ratios):.2f} times as large"
        f"{chance}."
    )
    return text


def _draw_shape(document: Mapping[str, Any]) -> Figure:
    """Draw confusion matrices: a column for every pad, a row for every set of shapes."""
    labels = list(document["settings"]["pads"])
    figure = Figure(figsize=(max(6.4, 1.2 + 2.7 * len(labels)), 6.2), layout="constrained")
    panels = figure.subplots(len(SETS), len(labels), squeeze=False)
    for matrix, row in zip(document["confusions"], document["rows"], strict=True):
        line, column = list(SETS).index(matrix["shapes"]), labels.index(matrix["pad"])
        axes, names = panels[line, column], matrix["names"]
        draw_confusions(axes, matrix["counts"])
        axes.set_xticks(range(len(names)), names, fontsize=8, color=INK)
        y_names = [""] * len(names) if column else names
        axes.set_yticks(range(len(names)), y_names, fontsize=8, color=INK, rotation=90, va="center")
        axes.set_title(f"{matrix['pad']}: {row['accuracy_percent']:.0f} %", loc="left", color=INK, fontsize=10)
        axes.set_ylabel("" if column else "pressed", color=INK)
        axes.set_xlabel("predicted" if line == len(SETS) - 1 else "", color=INK)
    add_title(figure, f"Which object was pressed, per cent of {document['settings']['test']} presses never trained on")
    return figure
