import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.common import plotting
from tests.helpers import golden as outputs
from tests.helpers.golden import Golden, figure_text, page_text, settle

KEPT = ["error 1.23 mm, 12 presses", "share 0.5012345678"]


@pytest.mark.parametrize(
    ("now", "same"),
    [
        ("error 1.24 mm, 12 presses", True),  # the last decimal
        ("error 1.25 mm, 12 presses", False),
        ("error 1.230 mm, 12 presses", False),  # other rounding
        ("error 1.23 mm, 13 presses", False),  # whole numbers count
        ("error 1.23 cm, 12 presses", False),
        ("error -1.23 mm, 12 presses", False),
    ],
)
def test_lines_may_differ_in_the_last_decimal_alone(now: str, same: bool) -> None:
    assert (settle([now], KEPT[:1], 1e-6) == KEPT[:1]) is same


def test_numbers_of_few_digits_must_be_the_same() -> None:
    assert settle(["0.2 mm of 6.2"], ["0.1 mm of 6.2"], 1e-6) == ["0.2 mm of 6.2"]
    assert settle(["0.1 mm of 6.2"], ["0.1 mm of 6.1"], 1e-6) == ["0.1 mm of 6.1"]


@given(st.floats(-2e-6, 2e-6))
def test_long_numbers_may_differ_by_a_share(difference: float) -> None:
    now = f"share {0.5012345678 * (1 + difference):.10f}"
    settled = settle([now], KEPT[1:], 1e-6) == KEPT[1:]
    assert settled or abs(difference) > 0.99e-6
    assert not settled or abs(difference) < 1.01e-6


def test_renewing_changes_only_what_differs(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(outputs, "FOLDER", tmp_path)
    Golden(tmp_path, renew=True)("a.txt", "\n".join(KEPT))
    with pytest.raises(pytest.fail.Exception, match=r"\+a new line"):
        Golden(tmp_path, renew=False)("a.txt", "error 1.24 mm, 12 presses\na new line\nshare 0.5012345677")
    Golden(tmp_path, renew=True)("a.txt", "error 1.24 mm, 12 presses\na new line\nshare 0.5012345677")
    assert (tmp_path / "a.txt").read_text().splitlines() == [KEPT[0], "a new line", KEPT[1]]
    with pytest.raises(pytest.fail.Exception, match=r"b\.txt"):
        Golden(tmp_path, renew=False)("b.txt", "of no file")


def test_figures_and_pages_are_told_by_what_they_show() -> None:
    figure, axes = plotting.new_figure(4, 3)
    axes.plot([0, 1], [2, 3], color="red", label="error")
    axes.imshow(np.arange(4).reshape(2, 2), vmin=0, vmax=5)
    axes.set_xlabel("x / mm")
    shown = figure_text(figure)
    for part in ("'x / mm'", "line 'error' #ff0000", "image (2, 2)"):
        assert part in shown
    axes.lines[0].set_ydata([2, 4])
    assert figure_text(figure) != shown

    page = "<html><h1>Pad</h1><table><tr><th>a</th><td>1</td></tr></table><svg viewBox='0 0 1 1'><path/></svg></html>"
    assert page_text(page).splitlines() == ["# Pad", "a | 1", "svg: 0 0 1 1 1 path"]
