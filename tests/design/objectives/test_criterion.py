"""The expected error against slow oracles and closed forms, and its gradient against differences."""

import numpy as np
import pytest

from padforge.design.morphology import Morphology
from padforge.design.objectives import criterion as module
from padforge.design.objectives.criterion import criterion, evaluation_windows, relative_error, window_presses
from padforge.design.objectives.fibre_loss import failure_masks
from padforge.design.settings import Contact, PadSettings, Scatter, SearchSettings
from tests.design.objectives.pads import square

SIDE, SIZE = 14, np.array([4.0, 4.0])
PAD = PadSettings(grid=4, sensed_mm=(45.0, 45.0))
PLACES, STEPS, FREE, _ = window_presses(PAD, PAD.sensed, SIDE, np.random.default_rng(0))
PLACES = PLACES - PAD.sensed[0]
SILENT = Scatter(1e-9)  # noise that adds nothing where signals tell the place


def errors(signals: np.ndarray, masks, scatter=SILENT, free=FREE) -> list[float]:
    return criterion(signals, PLACES, STEPS, free, np.array(masks), scatter, np.ones(len(signals)))[0].tolist()


def error(signals: np.ndarray, scatter=SILENT) -> float:
    return errors(signals, [[1.0] * len(signals)], scatter)[0]


def random_responses(fibres=3):
    return np.sin(PLACES @ np.random.default_rng(5).standard_normal((2, fibres))).T


def leave_one_out_error(signals: np.ndarray, rows=None) -> float:
    """Mean error of regressions that each lack one press, of those in some rows, or of all."""
    rows = np.arange(SIDE**2) if rows is None else rows
    scaled, places = signals.T / module.WIDTH, PLACES - PLACES.mean(axis=0)
    kernel = np.exp(-((scaled[:, None] - scaled[None]) ** 2).sum(axis=-1) / 2)
    distances = []
    for left_out in rows:
        others = rows[rows != left_out]
        matrix = kernel[np.ix_(others, others)] + module.RIDGE * np.eye(len(others))
        coefficients = np.linalg.solve(matrix, places[others])
        distances.append(np.linalg.norm(kernel[left_out, others] @ coefficients - places[left_out]))
    return float(np.mean(distances))


def bound(signals: np.ndarray, scatter: Scatter) -> float:
    """What noise adds, with all fibres, by which the expected error is above that of learning."""
    return (error(signals, scatter) - module.REGRESSION_WEIGHT * leave_one_out_error(signals)) / module.BOUND_WEIGHT


@pytest.mark.parametrize("size", [PadSettings(grid=16), PadSettings(horizontals=3, verticals=12)])
def test_evaluation_windows_tile_the_pressed_area(size):
    low, high = np.array(size.sensed)
    windows = [np.array(window) for window in evaluation_windows(size.sensed)]
    for window in (*windows, np.array(module.place_window(size.sensed, np.array([0.0, 0.9])))):
        assert (window[0] >= low - 1e-9).all()
        assert (window[1] <= high + 1e-9).all()
        assert np.ptp(window, axis=0).max() <= module.WINDOW + 1e-9
    area = sum(np.prod(window[1] - window[0]) for window in windows)
    assert area / np.prod(high - low) == pytest.approx(round(area / np.prod(high - low)))


def test_expected_error_ignores_presses_in_keep_outs():
    size = PadSettings(grid=4, keep_out_mm=(square(-15.0, -15.0, 30.0),))
    presses = window_presses(size, size.sensed, SIDE, np.random.default_rng(0))
    assert presses.free.mean() == pytest.approx(0.75, abs=0.05)
    answers, kept = random_responses(), [[1.0] * 3]
    changed = np.where(presses.free, answers, answers[:, ::-1] + 1.0)
    scattered = [errors(each, kept, Scatter(0.02), presses.free) for each in (answers, changed)]
    assert scattered[0] == pytest.approx(scattered[1])
    rows = np.flatnonzero(presses.free)
    expected = module.REGRESSION_WEIGHT * leave_one_out_error(answers, rows)
    assert errors(answers, kept, SILENT, presses.free)[0] == pytest.approx(expected, rel=1e-4)


def test_relative_error_is_a_power_mean_of_shares_of_straight_fibres():
    straight, shares = np.array([[0.1, 0.4], [0.2, 0.2]]), (0.5, 0.25, 0.25)  # of three numbers two occur
    assert relative_error(0.7 * straight, straight, shares)[0] == pytest.approx(0.7)
    errors = straight * [[0.6, 0.7], [1.0, 0.5]]
    value, gradient = relative_error(errors, straight, shares)
    of_powers = np.array([0.6, 0.7, 1.0, 0.5]) ** module.POWER @ [1 / 3, 1 / 6, 1 / 3, 1 / 6]
    assert value == pytest.approx(of_powers ** (1 / module.POWER))
    step = 1e-6 * np.random.default_rng(0).standard_normal(errors.shape)
    ahead, behind = (relative_error(errors + sign * step, straight, shares)[0] for sign in (1, -1))
    assert (ahead - behind) / 2 == pytest.approx((gradient * step).sum(), rel=1e-5)
    gains = gradient * errors
    assert gains[1, 0] > 0.9 * gains.sum(), "the worst weighs most"


def test_expected_error_without_signals_is_that_of_the_prior():
    silent = np.zeros((2, SIDE**2))
    assert bound(silent, Scatter(0.1)) == pytest.approx(np.sqrt(2 * 16 / 12), rel=1e-4)
    # about the mean distance of a place of a square of side 4 from its middle, 0.3826 sides
    regression = error(silent) - module.BOUND_WEIGHT * np.sqrt(2 * 16 / 12)
    assert regression == pytest.approx(module.REGRESSION_WEIGHT * 4 * 0.3826, rel=0.03)


@pytest.mark.parametrize("scatter", [SILENT, Scatter(0.05, 0.18, 0.36)])
def test_expected_error_gradient_matches_finite_differences(scatter):
    far = np.random.default_rng(8).uniform(0, 1, (3, 5))
    signals = np.concatenate([random_responses(), far], axis=1)
    places = np.concatenate([PLACES, np.full((5, 2), 9.0)])
    kept, shares = np.array([[1.0, 1, 1], [1, 0, 1]]), (0.6, 0.4)
    straight = np.array([[0.31, 0.48]])

    def joint(signals):
        errors, by_signals = criterion(signals, places, STEPS, FREE, kept, scatter, np.ones(3))
        value, by_means = relative_error(errors[None], straight, shares)
        return value, np.tensordot(by_means[0], by_signals, axes=1)

    way, steps = np.random.default_rng(6).standard_normal(signals.shape), 1e-3 * np.array([-2, -1, 1, 2])
    slope = np.array([1, -8, 8, -1]) / 12e-3 @ [joint(signals + step * way)[0] for step in steps]
    parts = joint(signals)[1] * way
    assert slope == pytest.approx(parts.sum(), abs=1e-3 * np.abs(parts).sum())


def test_confusable_matches_all_differences():
    """An oracle that forms every difference, of fibres that no press of the window touches too."""
    rng = np.random.default_rng(3)
    near, far = rng.uniform(0, 1, (6, 20)), 0.4 * rng.uniform(0, 1, (6, 200))
    near[4:] = 0.0
    masks = np.array([[1.0, 1, 1, 1, 1, 1], [1, 0, 1, 1, 0, 1]])
    squares = (far[:, :, None] - near[:, None]) ** 2
    distances = [np.sqrt(np.tensordot(mask, squares, axes=1)).min(axis=1) for mask in masks]
    least = np.min(distances, axis=0) / module.WIDTH
    expected = np.sort(np.argsort(least)[: module.MAX_PARTNERS])
    found = module.confusable(near, far, masks).tolist()
    assert found == [index for index in expected.tolist() if least[index] < module.MAX_PARTNER_DISTANCE]
    assert 0 < len(found) <= module.MAX_PARTNERS


def test_window_presses_sample_the_remaining_pad_coarsely():
    size = PadSettings(grid=9)
    window = module.place_window(size.sensed, 0.6)
    presses = window_presses(size, window, SIDE, np.random.default_rng(2))
    each = presses.positions.reshape(SIDE, SIDE, 2)
    assert np.diff(each[..., 0], axis=1) == pytest.approx(presses.step[0])
    assert np.diff(each[..., 1], axis=0) == pytest.approx(presses.step[1])
    low, high = np.array(window)
    assert ((presses.far < low - module.WINDOW_MARGIN) | (presses.far > high + module.WINDOW_MARGIN)).any(axis=1).all()
    rest = np.prod(np.diff(np.array(size.sensed), axis=0)) - np.prod(high - low)
    assert 0.5 * rest < len(presses.far) * module.COARSE_STEP**2 < rest
    size = PadSettings(grid=9, keep_out_mm=(square(-20.0, -20.0, 40.0),))
    far = window_presses(size, window, SIDE, np.random.default_rng(2)).far
    assert 0 < len(far) < len(presses.far)
    assert not (abs(Morphology.straight(9).to_mm(far) + 20) < 20).all(axis=1).any()


def test_evaluation_of_a_huge_pad_samples_windows_and_presses():
    """Of straight fibres full scale is by their length alone."""
    size = PadSettings(grid=96)
    windows = evaluation_windows(size.sensed)
    assert len(windows) == len(set(windows)) == module.MAX_WINDOWS
    presses = window_presses(size, windows[0], SIDE, np.random.default_rng(0))
    assert 0.9 * module.MAX_FAR < len(presses.far) <= module.MAX_FAR
    assert np.ptp(presses.far, axis=0).min() > 90
    profile = Contact(model="profile")
    small, large = (module.straight_full_scale(PadSettings(grid=n).layout, profile, "beyond") for n in (4, 96))
    assert large * 97 == pytest.approx(small * 5, rel=0.02)


def test_expected_error_ignores_failed_fibres_and_counts_distant_presses_with_equal_responses():
    other = random_responses()
    other[1] = other[1, ::-1]
    kept, scatter = [[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]], Scatter(0.01, 0.18, 0.36)
    found, changed = errors(random_responses(), kept, scatter), errors(other, kept, scatter)
    assert [changed[0], error(random_responses()[[0, 2]], scatter)] == pytest.approx([found[0]] * 2)
    assert found[1] != pytest.approx(changed[1])
    signals, kept = PLACES.T / 4, np.ones((1, 2))
    alike, other = signals[:, 90:91], signals[:, 90:91] + 3.0
    given = np.vstack([PLACES, [[30.0, 30.0]]]), STEPS, FREE, kept, SILENT, np.ones(2)
    confused, apart = (criterion(np.hstack([signals, far]), *given)[0][0] for far in (alike, other))
    assert apart == pytest.approx(error(signals), rel=0.2)
    assert confused > 5 * apart


def test_sets_that_are_alike_in_a_window_count_as_often_as_they_are(monkeypatch):
    """Those that fail beyond it; errors stand for which fibres of the window work."""

    def working(*arguments: np.ndarray, differentiate: bool) -> tuple[np.ndarray, bool]:
        masks = arguments[4]
        return masks @ np.arange(1.0, 1 + masks.shape[1]), differentiate

    monkeypatch.setattr(module, "window_presses", lambda *where: window_presses(*where)._replace(far=np.empty((0, 2))))
    monkeypatch.setattr(module, "criterion", working)
    given = Morphology.straight(12), Contact(model="profile"), SearchSettings(max_failures=1), PadSettings(grid=12)
    together, alone = module.criterion_errors(*given)[1], []
    for mask in failure_masks(24, 1, module.MIN_SETS):
        monkeypatch.setattr(module, "failure_masks", lambda *_, mask=mask: mask[None])
        alone.append(module.criterion_errors(*given)[1])
    assert together == pytest.approx(np.mean(alone))
