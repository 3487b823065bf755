"""Sensitivity to the pressing object: tools and depths other than those of the training (paper, figure 6).

A layer is pressed by tools of 0.5 to 1.5 times the radius, to 0.5 to 1.5 times the depth of the contact, in mm.
Responses scatter as on a built pad, since exact ones would localize even a press that fibres hardly respond to. In
place of a shape, the objects are the published ones, in grid units, and responses have no noise.
"""

import math
from collections.abc import Mapping
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from padforge.common.parallel import State
from padforge.common.plotting import CURVES, INK
from padforge.common.validation import InputError
from padforge.design.contact import relative_stretch, signals
from padforge.design.morphology import Morphology
from padforge.design.objectives.criterion import scatter_of_full_scale, straight_full_scale
from padforge.design.published.networks import SimulatedPresses, fit_batch
from padforge.design.settings import Contact, SearchSettings
from padforge.sense.arrays import Array
from padforge.sense.studies.study import Study, StudyResult, Task, describe_pads, label_axes

MEMBERS = 6  # networks whose errors are averaged, since that of a single one depends on its first weights
SIDE, TEST, HIDDEN = 32, 2000, 50
FACTORS = (0.5, 1.0, 1.5)  # of the radius of the tool and of its depth in a layer
RADII, SIDES = (0.6, 0.8, 1.0), (4, 30)  # published sizes K, grid units, and shapes D of the object, a polygon
SCATTER = SearchSettings().response_scatter  # scatter of the responses of a layer, as measured on a built pad


class _Objects(NamedTuple):
    """Fields, names and errors of the objects of a contact model."""

    size: str  # field of `Contact` that is their size
    other: str  # the other field that differs
    error: str  # column of their errors
    unit: str  # of the errors
    names: tuple[str, str]  # of a size and of a value of the other field, formats
    axes: tuple[str, str]  # labels of the size and of an object in the figure


_OBJECTS = {
    "layer": _Objects(
        *("tool_radius_mm", "depth_mm", "mean_mm", "mm"),
        ("a radius of {:g} mm", "{:g} mm deep"),
        ("radius of the tool, trained and tested with (mm)", "radius/depth"),
    ),
    "shape": _Objects(
        *("radius", "sides", "mean", "grid units"),
        ("K {:g}", "D {}"),
        ("size K of the object, trained and tested with (grid units)", "K/D"),
    ),
}


def sensitivity_study(pads: Mapping[str, Morphology], *, contact: Contact | None = None, seed: int = 0) -> Study:
    """Compare errors of networks for the object that they were trained with, and for other objects.

    The objects differ in tool radius and depth about those of the contact, if it is a layer, as `Contact()` is; in
    place of a shape they are the published ones.

    Raises:
        InputError: the contact is a profile.
    """
    contact = contact or Contact()
    if contact.model == "layer":
        sizes = [factor * contact.tool_radius_mm for factor in FACTORS]
        others = [depth for factor in FACTORS if (depth := factor * contact.depth_mm) < contact.thickness_mm]
    elif contact.model == "shape":
        sizes, others = list(RADII), list(SIDES)
    else:
        raise InputError(f"[contact] model is {contact.model}, allowed are layer and shape: only they have a size")
    kind = _OBJECTS[contact.model]
    objects = [
        contact.model_copy(update={kind.size: size, kind.other: other}) for other, size in product(others, sizes)
    ]
    tasks = [
        Task(f"{label}, trained with {_name(each)}", partial(_evaluate, pad, contact, each, objects, seed))
        for label, pad in pads.items()
        for each in objects
    ]
    settings = {
        "pads": describe_pads(pads),
        "contact": contact.model_dump(mode="json"),
        kind.size: sizes,
        kind.other: others,
        "members": MEMBERS,
        "hidden": HIDDEN,
        "presses": SIDE**2,
        "test": TEST,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), objects, settings)
    return Study("sensitivity", "Sensitivity to the object that presses", settings, tasks, conclude, _draw)


def _name(contact: Contact) -> str:
    kind = _OBJECTS[contact.model]
    size, other = kind.names
    return f"{size.format(getattr(contact, kind.size))}, {other.format(getattr(contact, kind.other))}"


def _evaluate(pad: Morphology, stated: Contact, trained: Contact, objects: list[Contact], seed: int) -> State:
    """Compute mean errors (MEMBERS, objects), grid units, of networks trained with one object.

    The noise floor of a layer's responses does not depend on the object.
    """
    rng = np.random.default_rng([5, seed])
    rngs, noise_rng = rng.spawn(MEMBERS), rng.spawn(1)[0]
    full_scale = straight_full_scale(pad.layout, stated, "fibres")
    scatter = scatter_of_full_scale(SCATTER, stated, full_scale)

    def respond(positions: Array, contact: Contact) -> Array:
        if contact.model == "shape":
            return signals(pad, positions, contact)
        stretch = relative_stretch(pad, positions, contact) / full_scale
        noise = scatter.floor * noise_rng.standard_normal(stretch.shape)
        return stretch * scatter.sample_gains(stretch.shape, noise_rng) + noise

    presses = SimulatedPresses.simulate(pad, SIDE, TEST, seed, partial(respond, contact=trained))
    networks = fit_batch(presses.train_signals, presses.train_positions, rngs, HIDDEN)
    tests = [respond(presses.test_positions, contact) for contact in objects]
    errors = [
        [presses.position_errors(network, (), test, presses.test_positions).mean() for test in tests]
        for network in networks
    ]
    return {"errors": np.array(errors)}


def _conclude(
    pads: Mapping[str, Morphology], objects: list[Contact], settings: Mapping[str, Any], states: list[State]
) -> StudyResult:
    kind, rows = _kind(settings), []
    results = iter(states)
    for label, pad in pads.items():
        for trained in objects:
            rows += [
                {
                    "pad": label,
                    **{f"trained_{name}": getattr(trained, name) for name in (kind.size, kind.other)},
                    **{name: getattr(tested, name) for name in (kind.size, kind.other)},
                    "mean": float(errors.mean()),
                    "std": float(errors.std()),
                    "mean_mm": float(errors.mean() * pad.unit_mm),
                }
                for tested, errors in zip(objects, next(results)["errors"].T, strict=True)
            ]
    return StudyResult(rows, [_describe(settings)])


def _kind(settings: Mapping[str, Any]) -> _Objects:
    return _OBJECTS[settings["contact"]["model"]]


def _error_matrix(settings: Mapping[str, Any], rows: list[dict[str, Any]], label: str) -> Array:
    """Return the mean errors of a pad by trained and tested object, each by depth or shape, then size."""
    means = [row[_kind(settings).error] for row in rows if row["pad"] == label]
    return np.reshape(means, (math.isqrt(len(means)), -1))


def _describe(settings: Mapping[str, Any]) -> str:
    kind = _kind(settings)
    sizes, others = settings[kind.size], settings[kind.other]
    if settings["contact"]["model"] == "layer":
        what = (
            f"Tools of {len(sizes)} radii press every pad to {len(others)} depths, less than its thickness. Responses "
            f"scatter by {100 * SCATTER.share:.0f} % and have noise of {100 * SCATTER.floor:.0f} % of what straight "
            "fibres of the default pad answer to the default press"
        )
    else:
        what = (
            f"Objects of {len(sizes)} sizes (radius K in grid units) and {len(others)} shapes (D sides) press every pad"
        )
    return (
        f"{what}; {settings['members']} networks of {settings['hidden']} neurons were trained on "
        f"{settings['presses']} presses with each object, and tested on {settings['test']} fresh presses with that one "
        f"and with every other. Errors are in {kind.unit}."
    )


def _draw(document: Mapping[str, Any]) -> Figure:
    """Draw errors by size for every depth or shape; and error matrices of trained by tested object."""
    rows, settings = document["rows"], document["settings"]
    kind, labels = _kind(settings), list(settings["pads"])
    sizes, others = settings[kind.size], settings[kind.other]
    figure = Figure(figsize=(max(6.4, 2.6 * len(labels)), 6.4), layout="constrained")
    grid = figure.add_gridspec(2, len(labels), height_ratios=[1.0, 1.0])
    axes = figure.add_subplot(grid[0, :])
    for number, label in enumerate(labels):
        colour = CURVES[number % len(CURVES)]
        trained = np.diag(_error_matrix(settings, rows, label)).reshape(len(others), -1)
        for other, style, errors in zip(others, ("--", "-", ":", "-."), trained, strict=False):
            name = f"{label}, {kind.names[1].format(other)}"
            axes.plot(sizes, errors, style, color=colour, marker="o", markersize=4, label=name)
    label_axes(axes, grid="y", xticks=sizes, ylim=(0, None), ylabel=f"mean error ({kind.unit})")
    axes.set_xlabel(kind.axes[0])
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    names = [f"{size:g}/{other:g}" for other, size in product(others, sizes)]
    highest = max(row[kind.error] for row in rows)
    for number, label in enumerate(labels):
        axes = figure.add_subplot(grid[1, number], aspect="equal")
        matrix = _error_matrix(settings, rows, label)
        axes.imshow(matrix, cmap="magma_r", vmin=0, vmax=highest)
        for (trained, tested), value in np.ndenumerate(matrix):
            colour = "w" if value > 0.6 * highest else INK
            axes.text(tested, trained, f"{value:.2f}", ha="center", va="center", fontsize=6, color=colour)
        axes.set_xticks(range(len(names)), names, fontsize=7, rotation=90)
        axes.set_yticks(range(len(names)), names if number == 0 else [""] * len(names), fontsize=7)
        axes.set_xlabel(f"tested with {kind.axes[1]}", fontsize=8)
        axes.set_ylabel(f"trained with {kind.axes[1]}" if number == 0 else "", fontsize=8)
        label_axes(axes, label)
    return figure
