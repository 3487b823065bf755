"""Moments of a press: which windows are complete before a reading, and that one network answers at each of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.sense.localizer.moments import (
    N_PRESS_WINDOWS,
    N_TIMED,
    PHASES,
    PRESS_WINDOWS,
    RELEASE_WINDOWS,
    RESIDUAL,
    RESIDUAL_PHASE,
    active_networks,
    complete_at,
    complete_windows,
)


def completed(down: int, up: int, until: int) -> list[bool]:
    """Window by window: all its readings are before `until`, those of the release after one of it at least."""
    of_touch = [until > up or all(down + n < until for n in range(*window)) for window in PRESS_WINDOWS]
    return of_touch + [until > up and all(up + n < until for n in range(*window)) for window in RELEASE_WINDOWS]


@given(down=st.integers(0, 5000), length=st.integers(1, 60), until=st.integers(-5, 120))
def test_complete_windows_counts_readings(down: int, length: int, until: int) -> None:
    up = down + length
    seen = complete_windows(np.array([down]), np.array([up]), np.array([down + until]))
    assert seen[0].tolist() == completed(down, up, down + until)
    assert seen[0].tolist() == sorted(seen[0].tolist(), reverse=True)  # one after the other


@given(count=st.integers(1, N_TIMED), length=st.integers(PRESS_WINDOWS[-1][1], 60))
def test_complete_at_is_the_first_reading_with_so_many_windows(count: int, length: int) -> None:
    down, up = np.array([0, 400]), np.array([length, 400 + length])
    at = complete_at(count, down, up)
    assert complete_windows(down, up, at).sum(axis=1).tolist() == [count] * 2
    assert (complete_windows(down, up, at - 1).sum(axis=1) < count).all()


@pytest.mark.parametrize("n_timed", PHASES)
def test_phases_cover_every_number_of_complete_windows(n_timed: int) -> None:
    phases = PHASES[n_timed].values()
    for count in range(n_timed > 0, n_timed + 1):
        names = {name: {} for name in PHASES[n_timed]}
        assert len(active_networks(names, count, n_timed, False)) == 1
        assert any(count in phase for phase in phases)
    assert not any(count in phase for count in (-1, n_timed + 1) for phase in phases)
    assert not any(0 in phase for phase in phases) or not n_timed
    for phase in (*phases, RESIDUAL_PHASE):
        assert sum(phase.shares) == pytest.approx(1)
        assert min(phase.shares) > 0


def test_answering_adds_the_bayesian_localizer_after_the_release() -> None:
    networks = {name: {} for name in PHASES[N_TIMED]}
    names = [active_networks(networks, count, N_TIMED, True) for count in range(N_TIMED + 1)]
    plain = [[], *[["touched"]] * (N_PRESS_WINDOWS - 1), ["settled"], *[["released"]] * len(RELEASE_WINDOWS)]
    assert names == [each + [RESIDUAL] * (count in RESIDUAL_PHASE) for count, each in enumerate(plain)]
    assert [active_networks(networks, count, N_TIMED, False) for count in range(N_TIMED + 1)] == plain
    assert active_networks({"press": {}}, 0, 0, True) == ["press", RESIDUAL]
    assert active_networks({"held": {}}, N_PRESS_WINDOWS, N_PRESS_WINDOWS, False) == ["held"]
