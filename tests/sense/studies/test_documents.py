"""What every study writes and draws of results that were made by hand, kept as a whole."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from padforge.design import Contact, Morphology
from padforge.design.settings import Scatter
from padforge.sense import Recording
from padforge.sense.studies.drift import COMPENSATIONS, FILTERS, drift_study
from padforge.sense.studies.fibre_loss import FibreLoss, MethodErrors, draw_fibre_loss, fibre_loss_lines
from padforge.sense.studies.indentation import SETS, force_study, shape_study
from padforge.sense.studies.learning_curve import LearningCurve, draw_learning_curve, learning_curve_lines
from padforge.sense.studies.multicontact import METHODS, multicontact_study
from padforge.sense.studies.press_model import PressModel
from padforge.sense.studies.robustness import SIDE, robustness_study
from padforge.sense.studies.scaling import scaling_study
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.strokes import SPEEDS_MM_S, strokes_study
from padforge.sense.studies.study import Study, Task, draw_error_map, run, study_lines
from tests.helpers.golden import Golden, json_text

pytestmark = pytest.mark.usefixtures("blank")
PADS = {"square": Morphology.straight(2), "wide": Morphology.straight((1, 3), 8.0)}
Results = tuple[Study, list[dict[str, Any]]]
"""A study, and a result for each of its tasks, in their order."""


def robustness() -> Results:
    """Errors grow by number of failed fibres and by set, maps from left to right, those of the second pad faster."""
    study = robustness_study(PADS, max_failures=1, presses=16, failed=(0, 2))
    ramp = np.tile(np.linspace(0, 0.3, SIDE), SIDE)
    states = [
        {"fresh": base + steps, "training": 0.9 * base + steps, "maps": base + steps[:, None] + slope * ramp}
        for slope, pad_base in ((1.0, 0.1), (2.0, 0.2))
        for base, steps in ((pad_base, np.zeros(1)), (2 * pad_base, np.array([0.01, 0.04, 0.02, 0.03])))
    ]
    chosen = [{"fresh": np.array([e]), "training": np.ones(1), "maps": e + ramp[None]} for e in (0.5, 0.75)]
    return study, states + chosen


def drift() -> Results:
    """Errors grow by filter and by compensation, and most for the last presses; a recording of known readings."""
    readings, down = np.ones((40 * 30, 2)), 40 * np.arange(30) + 20
    recording = Recording(readings, np.arange(1200) / 20, np.ones((30, 2)), down, down + 20, source={"kind": "csv"})
    study = drift_study({"plan": PADS["square"]}, {"built": recording})
    time_s = 60.0 + np.arange(6.0)
    states = [
        {
            **{f"test_{k}": np.array([[1.0, 2, 9], [2, 3, 13]]) + f + k / 4 for k in range(len(COMPENSATIONS))},
            **{f"last_{k}": np.array([[4.0, 6], [5, 9]]) + f + k / 2 for k in range(len(COMPENSATIONS))},
            "seconds": np.array(0.25 + f),
            "idle": np.array(0.125 + f / 16 + source / 4),
            "fibre": np.array(source),
            "readings": np.array([time_s, np.arange(6), np.arange(6) / 2]),
            "samples": np.array([[[61.0, 1], [62, 2], [63, 3]], [[63.5, 4], [64, 5], [65, 6]]]),
            "levels": np.array([[60.0, 1.0, 0.8], [600.0, 1.2, 0.9]]),
        }
        for source, f in product((0, 1), range(len(FILTERS)))
    ]
    return study, states


def force() -> Results:
    """Six presses from 1 to 5 mm, predicted to be deeper by a tenth, and 0.1 to 0.3 units away in x."""
    study = force_study({"square": PADS["square"]})
    depth = np.array([1.0, 1.5, 2.0, 3.0, 4.5, 5.0])
    pressed, states = np.column_stack([np.full((6, 2), 1.5), depth]), []
    for noise in (1.0, 2.0):
        for shift, columns in ((0.3, 3), (0.2, 2), (0.1, 3)):
            predicted = pressed * [1, 1, 1 + noise / 10] + np.outer(np.arange(6) / 5, [shift * noise, 0, 0])
            states.append({"pressed": pressed[:, :columns], "predicted": predicted[:, :columns]})
    return study, states


def shape() -> Results:
    """The second shape of each kind is recognized once in 4 presses, the others always."""
    states = []
    for scale, shapes in product((1.0, 2.0), SETS.values()):
        counts = 4 * np.eye(len(shapes), dtype=int)
        counts[1, :2] = 3, 1
        states += [{"confusions": counts}, {"unknown": np.array(0.5 * scale), "known": np.array(0.25 * scale)}]
    return shape_study(PADS), states


def multicontact() -> Results:
    """Pairs 0.2 to 2 units apart along x: exactly found, or their midpoint, or both moved by a tenth of a unit."""
    distance = np.linspace(0.2, 2.0, 20)
    pressed = np.zeros((20, 2, 2))
    pressed[:, 1, 0] = distance
    found = dict(zip(METHODS, (np.repeat(pressed.mean(axis=1, keepdims=True), 2, axis=1), pressed + 0.1), strict=False))
    found |= dict(zip(list(METHODS)[2:], (pressed[:, ::-1], pressed + np.array([0.0, 0.2])), strict=True))
    counts = np.array([[5, 1, 0, 0], [0, 5, 0, 0], [0, 0, 9, 0], [0, 0, 5, 0]])
    states = [*({"pressed": pressed, "predicted": found[method]} for method in METHODS), {"confusions": counts}]
    return multicontact_study({"square": PADS["square"]}), states


def strokes() -> Results:
    """Two strokes of ten readings: errors grow with the speed, and shrink from reading to reading."""
    speeds = np.arange(1.0, len(SPEEDS_MM_S) + 1)
    errors = speeds[:, None, None] * (2 - np.arange(10) / 10)[:, None] + np.array([-0.5, 0.5])
    within = errors < 4.0
    lifted = np.column_stack([speeds, speeds + 1])
    first = {"errors": errors, "within": within, "lifted": lifted}
    return strokes_study(PADS, presses=40, strokes=2), [first, first | {"errors": 2 * errors}]


def scaling() -> Results:
    """Presses in all cells of a map, whose errors grow along x, and less along y, and shrink from task to task."""
    pads = {"square": PADS["square"], "bent": Morphology.random(4, 2, 0)}
    study = scaling_study(pads, grids=(4, 8), press_model=PressModel(Contact(), Scatter(0.02, 0.18, 0.36)))
    x_y = np.stack(np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5), axis=-1).reshape(-1, 2) / 16
    states = []
    for number in range(len(study.tasks)):
        grid = 8 if number < len(study.tasks) / 2 else 4
        state = {"errors": (x_y @ [2.0, 1.0]) / (10 + number), "positions": 1 + (grid - 1) * x_y}
        states.append(state | {"seconds": np.array(2.126 * grid), "epochs": np.array(7 + number)})
    return study, states


def sensitivity() -> Results:
    """Two networks err by 1 unit more for each object further from the one that they were trained with, and later."""
    study = sensitivity_study(PADS)
    count = len(study.tasks) // len(PADS)
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    errors = apart + np.arange(count)[:, None] / 10
    return study, [{"errors": np.stack([row + base, row + base + 0.5])} for base in (1.0, 2.0) for row in errors]


STUDIES: dict[str, Callable[[], Results]] = {
    each.__name__: each for each in (robustness, drift, force, shape, multicontact, strokes, scaling, sensitivity)
}


def shortened(value: Any) -> Any:
    """JSON with a summary in place of each array of more than twelve numbers."""
    if isinstance(value, dict):
        return {name: shortened(part) for name, part in value.items()}
    if not isinstance(value, list) or not value:
        return value
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return [shortened(part) for part in value]
    if numbers.size <= 12:
        return value
    first, last, mean = (f"{number:.4g}" for number in (numbers.flat[0], numbers.flat[-1], numbers.mean()))
    corners = f", corners {numbers[0, -1]:.4g} and {numbers[-1, 0]:.4g}" if numbers.ndim == 2 else ""
    return f"{' x '.join(map(str, numbers.shape))} numbers, {first} ... {last}{corners}, mean {mean}"


@pytest.mark.parametrize("name", STUDIES)
def test_files_and_figure_of_a_study(name: str, golden: Golden, figures: list[Figure], tmp_path: Path) -> None:
    study, states = STUDIES[name]()
    assert len(states) == len(study.tasks)
    tasks = [Task(task.name, lambda state=state: state) for task, state in zip(study.tasks, states, strict=True)]
    document = run(replace(study, tasks=tasks), tmp_path, jobs=1)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".csv", ".json", ".md", ".png"]
    for end in ("md", "csv"):
        golden(f"studies/{name}.{end}", (tmp_path / f"{name}.{end}").read_text())
    written = json.loads((tmp_path / f"{name}.json").read_text())
    assert written == json.loads(json.dumps(document, allow_nan=False))
    assert written.pop("provenance").keys() == {"command", "seed", "versions", "inputs"}
    assert (written.pop("rows"), written.pop("text")) == (document["rows"], document["text"])  # in the other files
    golden(f"studies/{name}.json", json_text(shortened({"tasks": [task.name for task in tasks], **written})))
    (figure,) = figures
    golden(f"studies/{name}.figure.txt", figure)


def test_lines_of_a_study_are_a_table_and_paragraphs(golden: Golden) -> None:
    rows = [
        {"pad": "square", "n": 3, "mean_mm": 12.34567, "worst": "dome", "resolution_mm": None},
        {"pad": "a longer name", "n": 12, "mean_mm": 0.000123456, "worst": "-", "resolution_mm": 1e6},
    ]
    golden("studies/lines.txt", "\n".join(study_lines({"rows": rows, "text": ["One paragraph.", "Another."]})))


CELLS = [
    {"x_mm": x, "y_mm": y, "mean_mm": 1 + x / 10 + y / 5, "presses": 2} for y in (-5.0, 5.0) for x in (0.0, 8.0, 16.0)
]


def fibre_loss() -> FibreLoss:
    """Four fibres of which one fails, by two methods: the second errs by half a millimetre more."""
    methods = {}
    for name, more in (("one network", 0.0), ("retrained", 0.5)):
        means = [2.0 + more, *(3.0 + more + np.array([0.1, 0.4, 0.2, 0.3]))]
        sets = [], [0], [1], [2], [3]
        by_subset = [{"failed": failed, "mean_mm": mean} for failed, mean in zip(sets, means, strict=True)]
        errors = [
            {"n_failed": n, "subsets": k, "mean_mm": mean + more, "std_mm": mean / 4, "max_mm": 2 * mean}
            for n, k, mean in ((0, 1, 2.0), (1, 4, 3.25))
        ]
        maps = [{"failed": failed, "by_position": CELLS} for failed in ([], [1], [0, 3])]
        methods[name] = MethodErrors(errors, by_subset, maps)
    return FibreLoss("random", 255, 45, methods, {})


def test_lines_and_figure_of_fibre_loss(golden: Golden, figures: list[Figure], tmp_path: Path) -> None:
    draw_fibre_loss(fibre_loss(), tmp_path / "none.png")
    golden("studies/fibre_loss.txt", "\n".join(fibre_loss_lines(fibre_loss())))
    golden("studies/fibre_loss.figure.txt", figures[0])


def test_lines_and_figure_of_a_learning_curve(golden: Golden, figures: list[Figure], tmp_path: Path) -> None:
    """Errors of 1 + 8 / sqrt(n) mm after 16 and 64 presses."""
    points = [
        {"presses": 16, "mean_mm": 3.0, "standard_error_mm": 0.25},
        {"presses": 64, "mean_mm": 2.0, "standard_error_mm": 0.125},
    ]
    fit = {"floor_mm": 1.0, "factor_mm": 8.0, "exponent": 0.5}
    forecast = {"presses": 128, "mean_mm": 1.71, "low_mm": 1.25, "high_mm": 2.25}
    curve = LearningCurve(45, points, fit, forecast, "record more", {}, {})
    draw_learning_curve(curve, tmp_path / "none.png")
    golden("studies/learning_curve.txt", "\n".join(learning_curve_lines(curve)))
    golden("studies/learning_curve.figure.txt", figures[0])


def test_error_map_has_rows_upwards() -> None:
    axes: Any = Figure().add_subplot()
    image = draw_error_map(axes, [[1.0, 2.0], [3.0, 4.0]], "", 9.0, (0.0, 20.0, -5.0, 5.0))
    assert (image.origin, list(image.get_extent()), image.get_clim()) == ("lower", [0, 20, -5, 5], (0, 9))
    assert image.get_array().tolist() == [[1.0, 2.0], [3.0, 4.0]]
