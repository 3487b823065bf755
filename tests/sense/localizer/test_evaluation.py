"""Evaluation of a localizer by errors that are known; radii of few presses, by what other pads have shown."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gammaincinv

from padforge.sense import Recording
from padforge.sense.localizer.calibration import RELEASE, TOUCH, adapt_ratios
from padforge.sense.localizer.evaluation import (
    PRIOR_PRESSES,
    RATIO_SHAPE,
    conformal,
    error_row,
    find_doubts,
    idle_share,
)
from padforge.sense.localizer.model import Localization, LocalizerModel, MeasureEstimate

PLACES = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])


def off_by(*amounts: float, r50: float = 1.0, r90: float = 2.0, sd: float = 1.0) -> Localization:
    """The four presses found to the side by so many mm."""
    away = np.column_stack([amounts, np.zeros(4)])
    return Localization(PLACES + away, np.full((4, 2), sd), np.full(4, r50), np.full(4, r90))


def make_localization(ratios: np.ndarray) -> Localization:
    """Presses at (0, 0) that are off by shares of a radius of 2 mm."""
    size, radii = len(ratios), np.full(len(ratios), 2.0)
    return Localization(np.column_stack([2 * ratios, 0 * ratios]), np.full((size, 2), 2**0.5), radii, radii)


def test_error_row_summarizes_sets_and_known_measures() -> None:
    row = error_row(2, [off_by(0, 1, 2, 3), off_by(1, 1, 1, 9, r50=1.5, r90=8.0)], PLACES)
    assert (row["mean_mm"], row["std_mm"], row["max_mm"]) == pytest.approx((2.25, 0.75, 3.0))
    assert (row["median_mm"], row["p95_mm"]) == pytest.approx((1, 3 + 0.65 * 6))
    assert (row["within_r50"], row["within_r90"]) == pytest.approx((5 / 8, 6 / 8))
    depth = MeasureEstimate(np.array([1.0, 2, 3, 4]), np.full(4, 0.15))
    found = replace(off_by(0, 0, 0, 0), measures={"depth_mm": depth})
    depths = np.array([1.1, 2.0, 3.3, np.nan])
    row = error_row(0, [found], PLACES, {"depth_mm": depths, "force_n": depths})
    assert row["depth_mean_mm"] == pytest.approx(0.4 / 3)
    assert row["depth_within_r90"] == pytest.approx(2 / 3)
    assert not [key for key in error_row(0, [found], PLACES) if key.startswith("depth")]
    assert conformal([found], PLACES, {"depth_mm": depths})[3] == pytest.approx(0.3 / 0.15)
    assert conformal([found], PLACES)[3] == 1


def test_conformal_takes_a_quantile_one_rank_higher() -> None:
    """Ninety-nine presses off by 0.01, 0.02 ... of their radius: the 50th and the 90th."""
    ranks = np.random.default_rng(0).permutation(np.arange(1, 100) / 100)
    spread, r50, r90 = conformal([make_localization(ranks)], np.zeros((99, 2)))
    assert spread == pytest.approx(np.sqrt(np.square(ranks).mean()))
    assert (r50, r90) == pytest.approx((0.50, 0.90))
    assert conformal([make_localization(ranks[:5])], np.zeros((5, 2)))[2] == pytest.approx(ranks[:5].max())


@pytest.mark.parametrize("presses", [9, 40])
def test_conformal_covers_of_few_presses_and_several_sets(presses: int) -> None:
    rng = np.random.default_rng(presses)

    def drawn(count: int) -> list[Localization]:
        hard = rng.exponential(size=count)  # a press that is hard to find is so with every set
        return [make_localization(hard * rng.exponential(size=count)) for _ in range(3)]

    shares = []
    for _ in range(200):
        _, r50, r90 = conformal(drawn(presses), np.zeros((presses, 2)))
        fresh = np.concatenate([each.positions_mm[:, 0] / 2 for each in drawn(100)])
        shares.append([(fresh <= r50).mean(), (fresh <= r90).mean()])
    half, most = np.mean(shares, axis=0)
    assert 0.48 < half < 0.52 + 1 / presses
    assert 0.885 < most < 0.915 + 1 / presses


def test_idle_share_is_that_of_changes_below_a_share_of_their_range() -> None:
    """Of five presses of 20 readings, fibre 1 changes by 0 to 1 V, fibre 2 by far less than its 2 V in one."""
    steps = np.array([[0.0, 1.0], [0.015, -1.0], [0.025, 0.03], [1.0, 0.05], [0.5, 0.5]])
    is_pressed = np.repeat([0.0, 1.0, 0.0], [15, 20, 5])  # no longer in the last reading, which is in no window
    readings = (is_pressed[:, None] * steps[:, None]).reshape(200, 2)
    down_command = np.arange(5) * 40 + 15
    recording = Recording(readings, np.arange(200) / 13, np.zeros((5, 2)), down_command, down_command + 21)
    np.testing.assert_allclose(idle_share(recording), [2 / 5, 1 / 5])


@pytest.mark.parametrize("presses", [15, 30, 1000])
def test_radii_of_few_presses_differ_less_from_draw_to_draw(presses: int) -> None:
    """Ratios as other pads have them, of the mean that is known: shares are right, and no lottery."""
    rng, many = np.random.default_rng(presses), np.random.default_rng(0).gamma(RATIO_SHAPE, 0.67 / RATIO_SHAPE, 20_000)
    shares: dict[float | None, list[float]] = {None: [], 0.67: []}
    for _ in range(100):
        found = [make_localization(rng.gamma(RATIO_SHAPE, 0.67 / RATIO_SHAPE, presses))]
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
    assert spread == pytest.approx(np.sqrt((100 + 1 + 1 / RATIO_SHAPE) / 2), rel=1e-3)


@pytest.mark.parametrize(("presses", "factor", "low", "high"), [(5000, 1.2, 1.18, 1.22), (10, 1.2, 1.0, 1.15)])
def test_ratios_of_other_pads_are_adapted_to_presses_as_far_as_these_are_many(
    presses: int, factor: float, low: float, high: float
) -> None:
    expected = np.array([[0.7, 0.6], [0.9, 0.8]])
    quantiles = gammaincinv(RATIO_SHAPE, (np.arange(presses) + 0.5) / presses) / RATIO_SHAPE
    found = [[[make_localization(factor * mean * quantiles)] for mean in of_moment] for of_moment in expected]
    adapted = adapt_ratios(expected, found, np.zeros((presses, 2)))
    assert adapted is not None
    assert ((adapted >= low * expected) & (adapted <= high * expected)).all()
    contradicting = [[[make_localization(3 * quantiles)] for _ in of_moment] for of_moment in expected]
    assert adapt_ratios(expected, contradicting, np.zeros((presses, 2))) is None


def test_errors_grow_more_after_few_presses_at_the_end_of_a_press_and_with_all_fibres() -> None:
    assert RELEASE.growth(300) > RELEASE.growth(3000) > 1
    assert RELEASE.growth(300) > TOUCH.growth(300)
    assert RELEASE.ratio(300, 3 / 8) < RELEASE.ratio(300, 0) == RELEASE.mean_ratio


def test_far_presses_are_named_and_another_recording_is_doubted(
    localizer: LocalizerModel, recording: Recording
) -> None:
    localization = localizer.predict(recording)
    assert find_doubts(recording, localization, 0.9, 45) == []
    presses_mm = recording.presses_mm.copy()
    corner = int(np.argmin(presses_mm.sum(axis=1)))
    presses_mm[corner] *= -1  # a sign was lost
    presses_mm[3] = np.nan
    (line,) = find_doubts(replace(recording, presses_mm=presses_mm), localization, 0.9, 45)
    assert line.startswith(f"stated more than 4 r90 from where they are predicted: press {corner} at (")
    expected = ["2% of 300 presses lie within r90: is it the recording of this pad?"]
    assert find_doubts(recording, localization, 0.02, 300) == expected
    assert find_doubts(recording, localization, 0.02, 10) == []  # of so few it may be chance
