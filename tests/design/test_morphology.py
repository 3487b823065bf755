import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Morphology, signals
from padforge.design.morphology import assemble_knots
from padforge.design.settings import PUBLISHED_CONTACT, Layout
from tests.design.wild_pads import wild_pads


@given(wild_pads((1, 4), (0, 20)))
@settings(max_examples=30)
def test_assemble_knots_restores_a_pad(pad):
    np.testing.assert_allclose(assemble_knots(pad.knots[:, 1:-1]), pad.knots, atol=1e-12)


def test_positions_convert_both_ways_and_knots_are_separate_and_read_only():
    pad = Morphology.straight((4, 2), (8.0, 12.0))
    assert pad.to_mm(np.array(pad.layout.extent) / 2) == pytest.approx([0, 0])
    assert pad.to_mm([[0, 0], pad.layout.extent]) == pytest.approx(np.array([[-12, -30], [12, 30]]))
    assert pad.to_grid(pad.to_mm([[1.0, 4.0]])) == pytest.approx(np.array([[1.0, 4.0]]))
    assert pad.to_mm([]).shape == pad.to_grid([]).shape == (0, 2)
    with pytest.raises(ValueError, match="read-only"):
        Morphology.straight(2).knots[0, 0, 0] = 1
    heaped = Morphology(assemble_knots(np.full((2, 4, 2), 2.0))).knots
    assert heaped.max() == 2.0
    assert (np.diff(heaped[1, :, 1]) > 0).all()


def test_tiled_pads_respond_alike_in_every_tile():
    tile = Morphology.random(3, 4, seed=2, pitch_mm=5.0)
    pad = tile.tiled(4)
    assert (pad.grid, pad.pitch_mm) == (12, 5.0)
    places = np.random.default_rng(0).uniform(3.6, 6.4, (50, 2))
    answers = signals(pad, places, PUBLISHED_CONTACT).reshape(50, 2, 4, 3)
    moved = signals(pad, places + np.array([3, 0]), PUBLISHED_CONTACT).reshape(50, 2, 4, 3)
    # One tile to the right: the same horizontals, the verticals of the next tile.
    np.testing.assert_allclose(moved[:, 0], answers[:, 0], atol=1e-9)
    np.testing.assert_allclose(moved[:, 1, 1:], answers[:, 1, :-1], atol=1e-9)


@given(counts=st.tuples(st.integers(0, 3), st.integers(1, 3)), pitch_mm=st.tuples(*[st.floats(0.1, 1000)] * 2))
@settings(max_examples=8)
def test_file_round_trip(tmp_path_factory, counts, pitch_mm):
    pad = Morphology.random(Layout.create(counts, pitch_mm), 3, sum(counts))
    path = tmp_path_factory.mktemp("pads") / "pad.json"
    pad.save(path)
    again = Morphology.load(path)
    assert again == pad
    again.save(path.with_name("again.json"))
    assert path.read_bytes() == path.with_name("again.json").read_bytes()
    assert json.loads(path.read_text())["fibres"] == list(pad.layout.counts)
