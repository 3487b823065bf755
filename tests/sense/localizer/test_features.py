"""Features of presses: where windows lie, when they are complete, what they depend on, and how they are scaled."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.localizer import moments
from padforge.sense.localizer.features import N_HISTORY, PressFeatures, compute_features, interpolate_gaps
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import N_PRESS_WINDOWS, N_TIMED, PHASES, PRESS_WINDOWS, RELEASE_WINDOWS
from padforge.sense.localizer.scaler import MAX_INPUT, FeatureScaler, TargetScaler


def completed(down: int, up: int, until: int) -> list[bool]:
    """Window by window: all its readings are before `until`, those of the release after one of it at least."""
    of_touch = [until > up or all(down + n < until for n in range(*window)) for window in PRESS_WINDOWS]
    return of_touch + [until > up and all(up + n < until for n in range(*window)) for window in RELEASE_WINDOWS]


@given(down=st.integers(0, 5000), length=st.integers(1, 60), until=st.integers(-5, 120))
def test_complete_windows_counts_readings(down: int, length: int, until: int) -> None:
    up = down + length
    seen = moments.complete_windows(np.array([down]), np.array([up]), np.array([down + until]))
    assert seen[0].tolist() == completed(down, up, down + until)
    assert seen[0].tolist() == sorted(seen[0].tolist(), reverse=True)  # one after the other


@given(count=st.integers(1, N_TIMED), length=st.integers(PRESS_WINDOWS[-1][1], 60))
def test_complete_at_is_the_first_reading_with_so_many_windows(count: int, length: int) -> None:
    down, up = np.array([0, 400]), np.array([length, 400 + length])
    at = moments.complete_at(count, down, up)
    assert moments.complete_windows(down, up, at).sum(axis=1).tolist() == [count] * 2
    assert (moments.complete_windows(down, up, at - 1).sum(axis=1) < count).all()


def test_answering_adds_the_bayesian_localizer_after_the_release() -> None:
    networks = {name: {} for name in PHASES[N_TIMED]}
    names = [moments.active_networks(networks, count, N_TIMED, True) for count in range(N_TIMED + 1)]
    plain = [[], *[["touched"]] * (N_PRESS_WINDOWS - 1), *[["pressed"]] * (1 + len(RELEASE_WINDOWS))]
    assert names == [each + [moments.RESIDUAL] * (count in moments.RESIDUAL_PHASE) for count, each in enumerate(plain)]
    assert [moments.active_networks(networks, count, N_TIMED, False) for count in range(N_TIMED + 1)] == plain
    assert moments.active_networks({"press": {}}, 0, 0, True) == ["press", moments.RESIDUAL]
    assert moments.active_networks({"held": {}}, N_PRESS_WINDOWS, N_PRESS_WINDOWS, False) == ["held"]


PRESSES, FIBRES, WINDOWS = 5, 3, 4
N_WINDOWS = N_TIMED + len(moments.LATEST_WINDOWS)
DOWN_COMMAND = 40 * np.arange(PRESSES) + 20
UP_COMMAND = DOWN_COMMAND + 20


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((40 * PRESSES, FIBRES))


def windows_of(readings: np.ndarray, is_published: bool) -> np.ndarray:
    return compute_features(readings, DOWN_COMMAND, UP_COMMAND, None, is_published).windows


def test_compute_features_takes_means_and_medians() -> None:
    """Medians of noise; and of a ramp that counts itself, with a press from 5000 to 5020 and its rest 5.5 before it."""
    readings = noise()
    expected = [np.median(readings[at - 7 : at + 8], axis=0) for at in (90, 110, 130)]
    assert np.allclose(windows_of(readings, True)[2], np.stack(expected, axis=1))
    ramp = np.arange(5100.0)[:, None]
    down_command, up_command = np.array([5000]), np.array([5020])
    down = [1, 2, 3, 4, 5, 6.5, 9.5, 13.5, 17.5]
    up = [20, 21, 22, 23, 24.5, 27, 31, 36.5]
    now = [19, 18]
    past = [-1.5, -4, -8, -13, -17, -19.5, -25.5, -35.5, -45.5, -55.5, -70.5, -90.5, -110.5, -140.5]
    slow = [-402, -2010]
    found = compute_features(ramp, down_command, up_command)
    np.testing.assert_allclose(found.windows[0, 0], np.array(down + up + now) + 5.5)
    np.testing.assert_allclose(found.history[0, 0], np.array(past + slow) + 5.5)
    assert found.complete.all()
    # the latest readings before a moment; once the press has ended, the last of it
    for until, now in ((1, [0, 0]), (2, [1, 0]), (9, [8, 7]), (20, [19, 18]), (29, [19, 18])):
        latest = compute_features(ramp, down_command, up_command, down_command + until).windows[0, 0, N_TIMED:]
        np.testing.assert_allclose(latest, np.array(now) + 5.5)
    published = compute_features(ramp, down_command, up_command, is_published=True)
    np.testing.assert_allclose(published.windows[0, 0], [4990, 5010, 5030])
    assert (published.history.shape, published.complete.shape) == ((1, 1, 0), (1, 0))


@pytest.mark.parametrize("is_published", [False, True])
def test_compute_features_stays_within_press_and_fibre(is_published: bool) -> None:
    readings, press = noise(), 2
    before = windows_of(readings, is_published)
    readings[:, 1] = noise(1)[:, 1]
    after = windows_of(readings, is_published)
    assert np.array_equal(after[:, [0, 2]], before[:, [0, 2]])
    assert not np.array_equal(after[:, 1], before[:, 1])
    readings[:80] = readings[140:] = 99
    assert np.array_equal(windows_of(readings, is_published)[press], after[press])


@settings(max_examples=30)
@given(until=st.integers(1, 60), press=st.integers(0, PRESSES - 1))
def test_compute_features_ignores_readings_after_the_moment(until: int, press: int) -> None:
    readings, ends = noise(), DOWN_COMMAND + until
    before = compute_features(readings, DOWN_COMMAND, UP_COMMAND, ends)[press : press + 1]
    readings[ends[press] :] = 99
    after = compute_features(readings, DOWN_COMMAND, UP_COMMAND, ends)[press : press + 1]
    for name, part in vars(before).items():
        np.testing.assert_array_equal(getattr(after, name), part)


@pytest.mark.parametrize("is_published", [False, True])
@settings(max_examples=20)
@given(
    gaps=st.lists(st.integers(1, 30), min_size=2, max_size=20),
    after=st.integers(0, 30),
    until=st.none() | st.integers(-9, 60),
)
def test_compute_features_of_any_length(is_published: bool, gaps: list[int], after: int, until: int | None) -> None:
    edges = np.cumsum(gaps[: len(gaps) // 2 * 2])
    readings = np.random.default_rng(0).uniform(1, 2, (edges[-1] + after, 2))
    ends = None if until is None else edges[::2] + until
    found = compute_features(readings, edges[::2], edges[1::2], ends, is_published)
    shapes = [part.shape for part in (found.windows, found.history, found.complete)]
    q, sizes = len(edges) // 2, (3, 0, 0) if is_published else (N_WINDOWS, N_HISTORY, N_TIMED)
    assert shapes == [(q, 2, sizes[0]), (q, 2, sizes[1]), (q, sizes[2])]
    assert np.isfinite(found.windows).all()
    assert np.isfinite(found.history).all()
    assert found.fibre_mask.all()


def test_interpolate_gaps_fills_gaps_only() -> None:
    readings = noise()
    holed = readings.copy()
    holed[105] = holed[:3, 1] = np.nan
    filled = interpolate_gaps(holed)
    assert np.allclose(filled[105], (readings[104] + readings[106]) / 2)
    assert np.array_equal(filled[:3, 1], np.repeat(readings[3, 1], 3))
    there = ~np.isnan(holed)
    assert np.array_equal(filled[there], readings[there])
    assert compute_features(holed, DOWN_COMMAND, UP_COMMAND).fibre_mask.all()


@pytest.mark.parametrize(
    ("is_published", "until", "first", "end"),
    [(False, None, -10, 40), (False, 20, -10, 20), (False, 6, -10, 6), (True, None, -10, 40)],
)
def test_fibre_mask_needs_three_quarters(is_published: bool, until: int | None, first: int, end: int) -> None:
    """Press 2 is sent down at 100 and up at 120; the last readings that count are what is missing."""

    def computed(readings: np.ndarray) -> PressFeatures:
        ends = None if until is None else DOWN_COMMAND + until
        return compute_features(readings, DOWN_COMMAND, UP_COMMAND, ends, is_published)

    most = (end - first) // 4
    for missing, there in ((most, True), (most + 1, False)):
        for begin in (100 + first, 100 + end - missing):
            readings = noise()
            readings[begin : begin + missing, 1] = np.nan
            assert computed(readings).fibre_mask[2, 1] == there
    readings = noise()
    readings[50 : 100 + first, 1] = readings[100 + end : 140, 1] = readings[:, 2] = np.nan
    found = computed(readings)
    assert found.fibre_mask[2].tolist() == [True, True, False]
    assert np.isfinite(found.windows).all()


def make_presses(presses: int = 300) -> tuple[PressFeatures, np.ndarray]:
    """Presses without a history, each fibre and window of a size of its own, the last fibre dead in some of them."""
    rng = np.random.default_rng(0)
    sizes = rng.uniform(0.1, 2.0, (FIBRES, WINDOWS))
    windows = 3 + sizes * rng.standard_normal((presses, FIBRES, WINDOWS))
    fibre_mask = np.ones((presses, FIBRES), dtype=bool)
    fibre_mask[::4, 2] = False
    windows[::4, 2] = 1e3
    features = PressFeatures(windows, np.empty((presses, FIBRES, 0)), fibre_mask, np.empty((presses, 0), dtype=bool))
    return features, rng.uniform((-20, 0), (30, 10), (presses, 2))


def test_scaler_standardizes_features_and_positions() -> None:
    inputs, places = make_presses()
    scaling, _ = FeatureScaler.fit(inputs, places)
    own = inputs.windows[inputs.fibre_mask[:, 2], 2]
    np.testing.assert_allclose(scaling.mean_v[2], own.mean(axis=0))
    np.testing.assert_allclose(scaling.scale_v[2], np.sqrt(own.std(axis=0) * np.sqrt(own.var(axis=0).mean())))
    for sign in (1, -1):  # what lies far off is held
        assert (scaling.scale(sign * np.full((1, FIBRES, WINDOWS), 1e9)) == sign * MAX_INPUT).all()
    places[:4] = [[-20, 0], [30, 10], [30, 0], [5, 5]]
    scaling, _ = FeatureScaler.fit(inputs, places)
    np.testing.assert_allclose(scaling.origin_mm, [5, 5])
    assert scaling.scale_mm == 25
    np.testing.assert_allclose(scaling.scale_targets(places[:4]), [[-1, -0.2], [1, 0.2], [1, -0.2], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(scaling.positions_mm(scaling.scale_targets(places)), places, atol=1e-4)


@pytest.mark.parametrize("kind", ["silent", "never there", "rounding"])
def test_scaler_keeps_silent_fibres_finite(kind: str) -> None:
    inputs, places = make_presses(10)
    windows, fibre_mask = inputs.windows.copy(), inputs.fibre_mask.copy()
    windows[:, 1] = 3.3 + (1e-15 * windows[:, 1] if kind == "rounding" else 0)
    fibre_mask[:, 1] = kind != "never there"
    inputs = replace(inputs, windows=windows, fibre_mask=fibre_mask)
    scaling, table = FeatureScaler.fit(inputs, places)
    assert np.isfinite(scaling.transform(inputs).inputs).all()
    assert np.isfinite(table).all()
    assert (scaling.scale_v[1] == 1).all()


def test_scaled_depths_run_from_minus_1_to_1(deep_localizer: LocalizerModel) -> None:
    scaler = TargetScaler.fit("depth_mm", np.array([1.0, 2.0, 5.0]))
    assert (scaler.origin, scaler.scale) == (3.0, 2.0)
    assert scaler.transform(np.array([1.0, 3.0, 5.0])).tolist() == [-1, 0, 1]
    assert scaler.inverse_transform(np.array([-1.0, 0.5])).tolist() == [1, 4]
    depth = deep_localizer.scaler.measures[0]
    # a scaled depth of 1 responds as much more than one of 0 as it is deeper
    assert 1 + deep_localizer.scaler.depth_gain == pytest.approx((depth.origin + depth.scale) / depth.origin)
