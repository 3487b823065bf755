"""Shape: whether the fibres that locate a press also tell which object was pressed."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import INK, add_title, draw_confusions
from padforge.design.contact import signals
from padforge.design.indentation import Indenter, indented_signals
from padforge.design.morphology import Morphology
from padforge.design.networks import fresh_presses
from padforge.design.settings import Contact, between_fibres
from padforge.sense.recordings.processing.limits import Array, Indices
from padforge.sense.studies.pads import described
from padforge.sense.studies.study import Findings, Study, Task

from padforge.sense.studies.indentation.force import EPOCHS, MEMBERS, committee, magnitudes, readings

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
    return Study("shape", "Shape of what is pressed", settings, tasks, partial(_conclude, dict(pads), settings), _draw)


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


def _conclude(pads: Mapping[str, Morphology], settings: Mapping[str, Any], states: list[State]) -> Findings:
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
    return Findings(rows, _told(settings, rows), {"confusions": confusions})


def _told(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
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


def _draw(document: Mapping[str, Any]) -> Figure:
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
