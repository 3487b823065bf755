"""Figures of a calibration show what its document says."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.sense.localizer.evaluation import Evaluation
from padforge.sense.report import calibration


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Those that are drawn; nothing is written."""
    drawn: list[Any] = []
    monkeypatch.setattr(calibration, "save_figure", lambda figure, path: drawn.append(figure))
    return drawn


def make_evaluation(**parts: object) -> Evaluation:
    empty = {"errors": [], "by_subset": [], "by_position": [], "by_moment": [], "focus": {}, "idle_share": []}
    rest = {"split": "random", "test_presses": 3, "test": {}, "provenance": {}}
    return Evaluation(**(empty | rest | parts))  # type: ignore[arg-type]


def test_error_map_draws_true_positions_with_lines_to_those_predicted(figures: list[Any]) -> None:
    """Errors of 3, 5 and 10 mm."""
    pressed = [[0.0, 0.0], [10.0, 0.0], [0.0, -20.0]]
    predicted = [[0.0, 3.0], [13.0, 4.0], [-10.0, -20.0]]
    calibration.draw_error_map(
        make_evaluation(test={"pressed_mm": pressed, "predicted_mm": predicted}), Path("none.png")
    )
    axes = figures[0].axes[0]
    lines, dots = axes.collections
    assert [segment.tolist() for segment in lines.get_segments()] == np.stack([pressed, predicted], axis=1).tolist()
    assert np.asarray(dots.get_offsets()).tolist() == pressed
    assert np.asarray(dots.get_array()).tolist() == [3.0, 5.0, 10.0]
    assert axes.get_title("left").startswith("3 presses never trained on: mean error 6.00 mm")


def test_errors_by_moment_are_drawn_by_time_and_failed_fibres(figures: list[Any]) -> None:
    rows = [
        {"since": since, "n_failed": n_failed, "time_s": time_s, "mean_mm": (1 + n_failed) * (scale + time_s)}
        for since, scale in (("touch", 2.0), ("lift", 1.0))
        for time_s in (0.1, 0.2)
        for n_failed in (0, 1)
    ]
    moments = [{"predicted_mm": [1.0, 2.0], "r90_mm": 8.0}, {"predicted_mm": [1.5, 3.0], "r90_mm": 4.0}]
    evaluation = make_evaluation(by_moment=rows, focus={"pressed_mm": [2.0, 3.0], "moments": moments})
    calibration.draw_errors_by_moment(evaluation, Path("none.png"))
    touch, lift, focus = figures[0].axes
    for axes, since, scale in ((touch, "touch", 2.0), (lift, "lift", 1.0)):
        for n_failed, line in enumerate(axes.lines):
            assert (line.get_label(), list(line.get_xdata())) == (f"{n_failed} failed", [0.1, 0.2])
            assert line.get_ydata() == pytest.approx([(1 + n_failed) * (scale + time_s) for time_s in (0.1, 0.2)])
        assert axes.get_xlabel() == f"since the {since} (s)"
    early, late = focus.patches
    assert [(tuple(circle.center), circle.radius) for circle in (early, late)] == [((1.0, 2.0), 8.0), ((1.5, 3.0), 4.0)]
    assert early.get_alpha() < late.get_alpha()
    path, cross = focus.lines
    assert path.get_xydata().tolist() == [[1.0, 2.0], [1.5, 3.0]]
    assert cross.get_xydata().tolist() == [[2.0, 3.0]]
