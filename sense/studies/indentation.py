"""Force and shape: depth, force and object of a press, estimated from the fibres that localize it."""

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from itertools import product
from typing import Any, get_args

import numpy as np
from matplotlib.figure import Figure

from padforge.common.parallel import State
from padforge.common.plotting import CURVES, INK, add_title
from padforge.common.validation import InputError
from padforge.design.contact import indented_signals, press_forces_n, signals
from padforge.design.layer import REDUCED_MODULUS_KPA, solve_press
from padforge.design.morphology import Morphology
from padforge.design.published.networks import fresh_presses
from padforge.design.settings import Contact, Tool, between_fibres
from padforge.sense.arrays import Array, Indices
from padforge.sense.studies.study import (
    Sizes,
    Study,
    StudyResult,
    Task,
    classification_scores,
    classify,
    describe_pads,
    draw_confusions,
    fit_and_predict,
    label_axes,
    read_counts,
)

LOG_SCALE = 4.0
"""Counts below which the logarithm of a reading becomes linear, since readings there are mostly noise. A deeper press
multiplies all signals, and so adds a constant to their logarithms."""
DEPTHS = LOW, HIGH = 0.2, 1.0  # least and greatest, as a share of the contact's depth
MIDDLE = (LOW + HIGH) / 2
CASES = {"depth unknown": (DEPTHS, False), "depth known": (DEPTHS, True), "one depth": ((MIDDLE, MIDDLE), False)}
"""Range of depths, and whether the depth is an input, of the networks whose errors of the position are compared."""
FORCE_SIZES = Sizes(2048, 1024)
FORCE_NOISES = (1.0, 4.0)  # standard deviations of the readings' noise, counts of a 12-bit converter
BINS = 7  # depths by which the error of the position is drawn
COLUMNS = 4  # pads side by side in the figure of the force
TOOLS: tuple[Tool, ...] = get_args(Tool)
FOOTPRINTS = {"circle": None, "square": 4, "triangle": 3}  # sides of each polygon; None for a circle
SIZES = np.linspace(0.5, 0.9, 17)
"""Radii of circles of the same area as a footprint, grid units; one is drawn for every press."""
SHAPE_NOISE_COUNTS, SHAPE_SIZES = 1.0, Sizes(4096, 2048)
SETS = {"tools": TOOLS, "footprints": tuple(FOOTPRINTS)}


def force_study(
    pads: Mapping[str, Morphology], *, contact: Contact | None = None, sizes: Sizes = FORCE_SIZES, seed: int = 0
) -> Study:
    """Estimate position, depth and force of presses of random depth, from the signals of a pressed layer.

    Depths are 0.2 to 1 of that of the contact, `Contact()` if None. The error of the position is compared with errors
    by networks with the depth as an input, and with those of presses of the middle depth alone.

    Raises:
        InputError: the contact is no layer.
    """
    contact = _check_layer(contact)
    tasks = [
        Task(
            f"{label}, noise of {noise:g} count{'s' * (noise != 1)}, {name}",
            partial(_estimate_depth, pad, contact, *case, noise, sizes, seed),
        )
        for label, pad in pads.items()
        for noise in FORCE_NOISES
        for name, case in CASES.items()
    ]
    settings = {
        "pads": describe_pads(pads),
        "contact": contact.model_dump(mode="json"),
        "depths_mm": [share * contact.depth_mm for share in DEPTHS],
        "noise_counts": list(FORCE_NOISES),
        "reduced_modulus_kpa": REDUCED_MODULUS_KPA,
        "seed": seed,
        **asdict(sizes),
    }
    conclude = partial(_conclude_force, dict(pads), contact, settings)
    return Study("force", "Depth and force of a press, besides its position", settings, tasks, conclude, _draw_force)


def _check_layer(contact: Contact | None) -> Contact:
    """Return the contact, the default one if None; refuse one that is no layer."""
    contact = contact or Contact()
    if contact.model != "layer":
        raise InputError(f"[contact] model is {contact.model}, allowed is layer: nothing else is pressed to a depth")
    return contact


def _estimate_depth(
    pad: Morphology,
    contact: Contact,
    depths: tuple[float, float],
    is_known: bool,
    noise_counts: float,
    sizes: Sizes,
    seed: int,
) -> State:
    """Return the test presses, "pressed" and "predicted": x and y, grid units, and the depth, mm, unless it is known.

    `depths` are the least and the greatest one, as shares of the contact's.
    """
    rng, count = np.random.default_rng([3, seed]), sizes.presses + sizes.test
    positions = fresh_presses(between_fibres(pad.layout), count, int(rng.integers(2**32)))
    depth_mm = contact.depth_mm * rng.uniform(*depths, count)
    responses = indented_signals(pad, positions, depth_mm, contact)
    inputs = signed_logarithm(read_counts(responses, sizes.presses, noise_counts, rng))
    targets = np.column_stack([positions, depth_mm])
    if is_known:
        inputs, targets = np.column_stack([inputs, depth_mm]), positions
    return {"pressed": targets[sizes.presses :], "predicted": fit_and_predict(inputs, targets, rng, sizes)}


def signed_logarithm(counts: Array) -> Array:
    """Return the logarithm of the magnitude of readings, with their sign, linear below LOG_SCALE."""
    return np.sign(counts) * np.log1p(np.abs(counts) / LOG_SCALE)


def _conclude_force(
    pads: Mapping[str, Morphology], contact: Contact, settings: Mapping[str, Any], states: list[State]
) -> StudyResult:
    low_mm, middle_mm, high_mm = (share * contact.depth_mm for share in (LOW, MIDDLE, HIGH))
    edges = np.linspace(low_mm, high_mm, BINS + 1)
    force_n = partial(press_forces_n, contact=contact)
    range_n = float(force_n(high_mm) - force_n(low_mm))
    rows, curves = [], []
    results = iter(states)
    for label, pad in pads.items():
        for noise in FORCE_NOISES:
            cases = [next(results) for _ in CASES]
            depth, predicted = cases[0]["pressed"][:, 2], np.clip(cases[0]["predicted"][:, 2], low_mm, high_mm)
            errors, depth_known, one_depth = (
                pad.unit_mm * np.linalg.norm(case["predicted"][:, :2] - case["pressed"][:, :2], axis=1)
                for case in cases
            )
            force_error_n, force_guess_n = (
                float(np.abs(force_n(guess) - force_n(depth)).mean()) for guess in (predicted, middle_mm)
            )
            row = {
                "pad": label,
                "noise_counts": noise,
                "position_mm": float(errors.mean()),
                "position_depth_known_mm": float(depth_known.mean()),
                "position_one_depth_mm": float(one_depth.mean()),
                "depth_mm": float(np.abs(predicted - depth).mean()),
                "depth_guessed_mm": float(np.abs(depth - middle_mm).mean()),
                "force_n": force_error_n,
                "force_percent": 100 * force_error_n / range_n,
                "force_guessed_percent": 100 * force_guess_n / range_n,
            }
            rows.append(row)
            bins = np.digitize(depth, edges[1:-1])
            means = [float(errors[bins == bin].mean()) if bin in bins else None for bin in range(BINS)]
            curve = {
                "pad": label,
                "noise_counts": noise,
                "pressed_mm": np.round(depth, 4).tolist(),
                "predicted_mm": np.round(predicted, 4).tolist(),
                "bin_depth_mm": ((edges[1:] + edges[:-1]) / 2).tolist(),
                "bin_position_mm": means,
            }
            curves.append(curve)
    return StudyResult(rows, _describe_force(contact, settings), {"curves": curves})


def _describe_force(contact: Contact, settings: Mapping[str, Any]) -> list[str]:
    low_mm, high_mm = settings["depths_mm"]
    noises = " or ".join(f"{noise:g}" for noise in FORCE_NOISES)
    model = (
        f"A {contact.tool} of radius {contact.tool_radius_mm:g} mm is pressed {low_mm:g} to {high_mm:g} mm deep into a "
        f"{contact.base} layer {contact.thickness_mm:g} mm thick at random positions. Fibres answer to its strains, "
        f"read by a 12-bit converter whose full scale is the fibre's largest signal, with noise of {noises} counts. "
        f"Networks of {settings['hidden']} neurons, of which the mean of {settings['members']} is taken, estimate x, y "
        f"and depth from the readings' logarithms; they were trained on {settings['presses']} presses and tested on "
        f"{settings['test']} others."
    )
    columns = (
        "Errors are those of position, depth and force; of the position also if the depth is an input, and if all "
        f"presses are {MIDDLE * contact.depth_mm:g} mm deep; and of depth and force by guessing the middle depth."
    )
    caution = (
        f"Depth and force are related by the mechanics of a linear elastic layer of reduced modulus "
        f"{REDUCED_MODULUS_KPA:.0f} kPa. Silicone stiffens where it is strained, and creeps: forces of a built pad "
        "need a calibration against a load cell."
    )
    return [model, columns, caution]


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
    pads: Mapping[str, Morphology], *, contact: Contact | None = None, sizes: Sizes = SHAPE_SIZES, seed: int = 0
) -> Study:
    """Classify objects at unknown positions: tools at unknown depths, and footprints of unknown sizes.

    Tools have the radius and depths of the contact, `Contact()` if None, and press its layer. Footprints are polygons
    of one orientation under the published contact.

    Raises:
        InputError: the contact is no layer.
    """
    contact = _check_layer(contact)
    tasks = [
        Task(f"{label}, {kind}, {name}", partial(work, pad, contact, kind, sizes, seed))
        for label, pad in pads.items()
        for kind in SETS
        for name, work in (("shape", _classify_shapes), ("position", _localize))
    ]
    settings = {
        "pads": describe_pads(pads),
        "contact": contact.model_dump(mode="json"),
        "depths_mm": [share * contact.depth_mm for share in DEPTHS],
        "sizes": [float(SIZES[0]), float(SIZES[-1])],
        "noise_counts": SHAPE_NOISE_COUNTS,
        "seed": seed,
        **asdict(sizes),
    }
    conclude = partial(_conclude_shape, dict(pads), contact, settings)
    return Study("shape", "Shape of what is pressed", settings, tasks, conclude, _draw_shape)


def tool_contacts(contact: Contact) -> dict[str, Contact]:
    """Return the contact of each of TOOLS, by name.

    All have the radius of the contact's tool except the flat end, which has the contact radius of the dome at the
    middle depth: tools differ by their profile more than by their size.
    """
    layer = contact.thickness_mm, contact.base
    dome = solve_press("dome", contact.tool_radius_mm, MIDDLE * contact.depth_mm, *layer)
    radii_mm = dict.fromkeys(TOOLS, contact.tool_radius_mm) | {"flat": dome.contact_radius_mm}
    return {tool: contact.model_copy(update={"tool": tool, "tool_radius_mm": radii_mm[tool]}) for tool in TOOLS}


def _simulate_shapes(
    pad: Morphology, contact: Contact, kind: str, sizes: Sizes, seed: int
) -> tuple[Array, Array, Indices, np.random.Generator]:
    """Return network inputs (Q, C), positions (Q, 2), indices of the shapes (Q,), and the generator to go on with."""
    rng, count = np.random.default_rng([4, seed, list(SETS).index(kind)]), sizes.presses + sizes.test
    positions = fresh_presses(between_fibres(pad.layout), count, int(rng.integers(2**32)))
    shape = rng.integers(len(SETS[kind]), size=count)
    responses = np.empty((count, pad.layout.fibres))
    if kind == "tools":
        depths_mm = contact.depth_mm * rng.uniform(*DEPTHS, count)
        for index, tool in enumerate(tool_contacts(contact).values()):
            rows = shape == index
            responses[rows] = indented_signals(pad, positions[rows], depths_mm[rows], tool)
    else:
        size = rng.integers(len(SIZES), size=count)
        for (index, sides), (size_index, radius) in product(enumerate(FOOTPRINTS.values()), enumerate(SIZES)):
            rows = (shape == index) & (size == size_index)
            footprint = Contact(radius=radius * circumradius(sides), sides=sides)
            responses[rows] = signals(pad, positions[rows], footprint)
    counts = read_counts(responses, sizes.presses, SHAPE_NOISE_COUNTS, rng)
    return signed_logarithm(counts) if kind == "tools" else counts, positions, shape, rng


def circumradius(sides: int | None) -> float:
    """Return the circumradius of a regular polygon with the area of a circle of radius 1."""
    return 1.0 if sides is None else float(np.sqrt(2 * np.pi / (sides * np.sin(2 * np.pi / sides))))


def _classify_shapes(pad: Morphology, contact: Contact, kind: str, sizes: Sizes, seed: int) -> State:
    inputs, _, shape, rng = _simulate_shapes(pad, contact, kind, sizes, seed)
    return classify(inputs, shape, len(SETS[kind]), rng, sizes)


def _localize(pad: Morphology, contact: Contact, kind: str, sizes: Sizes, seed: int) -> State:
    """Return mean errors of the position on the test presses, grid units: shape "unknown", or "known" as an input."""
    inputs, positions, shape, rng = _simulate_shapes(pad, contact, kind, sizes, seed)
    with_shape = np.column_stack([inputs, np.eye(len(SETS[kind]))[shape]])
    errors = {}
    for name, features, member_rng in zip(("unknown", "known"), (inputs, with_shape), rng.spawn(2), strict=True):
        predicted = fit_and_predict(features, positions, member_rng, sizes)
        errors[name] = np.linalg.norm(predicted - positions[sizes.presses :], axis=1).mean()
    return errors


def _conclude_shape(
    pads: Mapping[str, Morphology], contact: Contact, settings: Mapping[str, Any], states: list[State]
) -> StudyResult:
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
    return StudyResult(rows, _describe_shape(contact, settings), {"confusions": confusions})


def _describe_shape(contact: Contact, settings: Mapping[str, Any]) -> list[str]:
    low_mm, high_mm = settings["depths_mm"]
    flat_mm = tool_contacts(contact)["flat"].tool_radius_mm
    model = (
        f"Tools: a dome, a ball and a finger of radius {contact.tool_radius_mm:g} mm, and a flat end of radius "
        f"{flat_mm:.1f} mm, pressed {low_mm:g} to {high_mm:g} mm deep into a {contact.base} layer "
        f"{contact.thickness_mm:g} mm thick. Footprints: circle, square and triangle of equal area, that of a circle "
        f"of {SIZES[0]:g} to {SIZES[-1]:g} grid units radius, of one orientation, under the published contact model. "
        f"Readings are whole counts of 12 bits with noise of {SHAPE_NOISE_COUNTS:g}. Position, depth and size are "
        f"drawn for every press; networks of {settings['hidden']} neurons, of which the mean of {settings['members']} "
        f"is taken, were trained on {settings['presses']} presses of a set and tested on {settings['test']} others."
    )
    columns = (
        "The majority is the accuracy of always naming the most frequent shape. Errors of the position are given for "
        "networks without and with the shape as an input."
    )
    return [model, columns]


def _draw_shape(document: Mapping[str, Any]) -> Figure:
    """Draw confusion matrices: a column for every pad, a row for every set of shapes."""
    labels = list(document["settings"]["pads"])
    figure = Figure(figsize=(max(6.4, 1.2 + 2.7 * len(labels)), 6.2), layout="constrained")
    panels = figure.subplots(len(SETS), len(labels), squeeze=False)
    for matrix, row in zip(document["confusions"], document["rows"], strict=True):
        line, column = list(SETS).index(matrix["shapes"]), labels.index(matrix["pad"])
        axes, names = panels[line, column], matrix["names"]
        title, is_last = f"{matrix['pad']}: {row['accuracy_percent']:.0f} %", line == len(SETS) - 1
        draw_confusions(axes, matrix["counts"], title, "predicted" * is_last, "" if column else "pressed")
        axes.set_xticks(range(len(names)), names, fontsize=8, color=INK)
        y_names = [""] * len(names) if column else names
        axes.set_yticks(range(len(names)), y_names, fontsize=8, color=INK, rotation=90, va="center")
    add_title(figure, f"Which object was pressed, per cent of {document['settings']['test']} presses never trained on")
    return figure
