"""Radii of few presses: what other pads have shown, and presses that contradict it."""

import numpy as np
import pytest

from padforge.sense.localizer.evaluation import PRIOR_PRESSES, conformal, sureness_lines
from padforge.sense.localizer.model import Localization


def make_localization(ratios: np.ndarray) -> Localization:
    """Presses at (0, 0) that are off by shares of a radius of 2 mm."""
    size = len(ratios)
    return Localization(
        np.column_stack([2 * ratios, 0 * ratios]), np.full((size, 2), 2**0.5), np.full(size, 2.0), np.full(size, 2.0)
    )


@pytest.mark.parametrize("presses", [15, 30, 1000])
def test_radii_of_few_presses_differ_less_from_draw_to_draw(presses: int) -> None:
    """Ratios as other pads have them, of the mean that is known: shares are right, and no lottery."""
    rng, many = np.random.default_rng(presses), np.random.default_rng(0).gamma(2.3, 0.67 / 2.3, 20_000)
    shares: dict[float | None, list[float]] = {None: [], 0.67: []}
    for _ in range(100):
        found = [make_localization(rng.gamma(2.3, 0.67 / 2.3, presses))]
        for prior in shares:
            shares[prior].append(float((many <= conformal(found, np.zeros((presses, 2)), None, prior)[2]).mean()))
    assert np.mean(shares[0.67]) == pytest.approx(0.9, abs=0.01)
    assert np.std(shares[0.67]) < (0.6 if presses < 100 else 1.0) * np.std(shares[None])


def test_prior_counts_as_so_many_presses() -> None:
    """As many presses as the prior counts for, all ten times as far off as it says."""
    far = make_localization(np.full(PRIOR_PRESSES, 10.0))
    spread, r50, r90 = conformal([far], np.zeros((PRIOR_PRESSES, 2)), None, 1.0)
    assert r90 == pytest.approx(10.0)
    assert 2.0 < r50 < 10.0
    assert spread == pytest.approx(np.sqrt((100 + 1 + 1 / 2.3) / 2), rel=0.01)


def test_radii_of_few_presses_say_so() -> None:
    assert sureness_lines({"radii_presses": 100}) == [
        "radii rest on few presses: of many others 84% to 96% may lie in r90"
    ]
    assert sureness_lines({"radii_presses": 400}) == sureness_lines({}) == []
