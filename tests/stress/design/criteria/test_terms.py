"""Information, terms and penalties of wild pads."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.criteria.information import (
    disorder,
    disorder_area,
    idle_share,
    information,
    joint_entropy,
    published_sharpness,
    quantize,
)
from design.criteria.penalties import penalties
from design.criteria.published_objective import published_terms
from design.optimisers.parametrization import Fibres
from design.pad.contact import fibre_axes
from design.settings import PadSettings, RulesSettings
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.values import LAX, contacts, pads, seeds


@settings(few(60), suppress_health_check=LAX)
@given(seeds(), st.integers(0, 30), st.integers(0, 5), st.sampled_from([0, 1e-300, 5e-324, 1e-9, 1.0, 1e300]))
def test_quantities_of_information_keep_to_their_bounds(seed, count, columns, scale):
    rng = np.random.default_rng(seed)
    values = rng.choice([rng.normal(size=(count, columns)), rng.integers(0, 2, (count, columns))]) * scale
    for layout in (
        values,
        np.asfortranarray(values),
        np.repeat(values, 2, axis=0)[::2],
        values.astype("f4" if scale < 1e30 else "f8"),
    ):
        levels = quantize(layout, 16)
        assert ((levels >= 0) & (levels <= 16)).all()
        assert (levels == np.round(levels)).all()
        entropy = joint_entropy(levels)
        assert -1e-12 <= entropy <= math.log2(max(count, 1)) + 1e-9
        assert 0 <= published_sharpness(levels) <= 4 * 16 * count * columns
        assert 0 <= idle_share(layout) <= 1
    numbers = np.unique(levels, axis=0, return_counts=True)[1] if columns and count else np.array([1])
    expected = -(numbers / numbers.sum() * np.log2(numbers / numbers.sum())).sum()
    assert joint_entropy(levels) == pytest.approx(expected, abs=1e-9)


@settings(few(15), suppress_health_check=LAX)
@given(st.data())
def test_terms_of_a_wild_pad_are_finite(data):
    pad, contact = data.draw(pads((1, 2), (0, 6))), data.draw(contacts())
    with ends_in_time():
        terms = published_terms(pad, contact, samples=data.draw(st.sampled_from([2, 3, 500])))[0]
        told = information(pad, contact, side=6)
        area = disorder_area(pad)
    assert np.isfinite([terms.entropy, terms.sharpness, terms.disorder, terms.objective, told, area]).all()
    assert 0 <= terms.entropy <= 2 * math.log2(49) + 1e-9
    assert area >= 0
    if np.diff(fibre_axes(pad)[0]).min() > 0.05:
        assert disorder(pad.knots, 20_001) * (pad.grid + 1) / 20_000 == pytest.approx(area, abs=2e-3 * (1 + area))


@settings(few(20), suppress_health_check=LAX)
@given(st.data())
def test_penalties_and_their_gradients_are_finite(data):
    import torch

    pad = data.draw(pads((1, 2), (1, 6)))
    rules = RulesSettings(
        min_gap_mm=data.draw(st.sampled_from([0.0, 0.8, 5.0])),
        same_family_crossings=data.draw(st.sampled_from([0, 2])),
        max_crossings=data.draw(st.sampled_from([None, 9])),
        min_crossing_angle_deg=data.draw(st.sampled_from([0.0, 40.0])),
    )
    course = Fibres.through(pad.knots, pad.layout, 0.01)
    assert np.isfinite(course.knots()).all()
    with ends_in_time():
        found = penalties(*course.axes(), PadSettings(grid=pad.grid, pitch_mm=pad.pitch_mm), rules)
        torch.stack(list(found.values())).sum().backward()
    assert all(value.isfinite() and value >= 0 for value in found.values())
    assert course.spans.grad is not None
    assert course.spans.grad.isfinite().all()
    assert course.cross.grad is not None
    assert course.cross.grad.isfinite().all()
