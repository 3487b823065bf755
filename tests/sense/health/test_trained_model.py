"""The rate of learning over a training."""

import numpy as np
import pytest

from sense.health.trained_model import one_cycle


def test_the_rate_rises_once_and_ends_at_nothing() -> None:
    rates = np.array([one_cycle(share) for share in np.linspace(0, 1, 101)])
    assert rates.max() == 1
    assert rates[-1] == pytest.approx(0)
    peak = int(rates.argmax())
    assert (np.diff(rates[: peak + 1]) > 0).all()
    assert (np.diff(rates[peak:]) < 0).all()


@pytest.mark.parametrize(("share", "rate"), [(0.05, 0.25), (0.1, 0.5), (0.2, 1.0), (0.4, 0.8535533906), (0.6, 0.5)])
def test_the_rate_rises_along_a_line_and_falls_along_a_cosine(share: float, rate: float) -> None:
    assert one_cycle(share) == pytest.approx(rate)
