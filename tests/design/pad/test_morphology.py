"""Morphologies: construction, files, refusals."""

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from design import InputError, Morphology, signals
from design.pad.knots import assemble
from design.settings import PUBLISHED_CONTACT


@given(grid=st.integers(1, 5), knots=st.integers(0, 6), seed=st.integers(0, 2**32 - 1))
def test_random_morphologies_hold_the_invariants_and_depend_on_the_seed_alone(grid, knots, seed):
    pad = Morphology.random(grid, knots, seed)
    assert pad.knots.shape == (2 * grid, knots + 2, 2)
    assert pad == Morphology.random(grid, knots, np.random.default_rng(seed))
    for fibre, points in enumerate(pad.knots):
        axis = 0 if fibre < grid else 1
        assert (np.diff(points[:, axis]) > 0).all()
        assert tuple(points[[0, -1], axis]) == (0, grid + 1)


def test_saving_and_loading_keeps_every_bit(tmp_path):
    pad = Morphology.random(3, 4, seed=1, pitch_mm=7.3)
    pad.save(tmp_path / "pad.json")
    assert Morphology.load(tmp_path / "pad.json") == pad


def test_knots_at_one_travel_coordinate_are_moved_apart():
    inner = np.full((2, 5, 2), 0.7)
    pad = Morphology(assemble(inner))
    assert (np.diff(pad.knots[0, :, 0]) > 0).all()
    assert np.abs(pad.knots[0, 1:-1] - 0.7).max() < 1e-8


def test_knots_heaped_at_the_far_edge_stay_inside_it():
    pad = Morphology(assemble(np.full((2, 4, 2), 2.0)))
    assert pad.knots.max() == 2.0
    assert (np.diff(pad.knots[1, :, 1]) > 0).all()


def test_knots_cannot_be_changed_afterwards():
    with pytest.raises(ValueError, match="read-only"):
        Morphology.straight(2).knots[0, 0, 0] = 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda k: k[:3], r"shape \(3, 3, 2\), expected \(2 M, N \+ 2, 2\)"),
        (lambda k: k * np.nan, "NaN"),
        (lambda k: k + 0.1, r"a knot lies at x = 3\.1, allowed is 0 to 3 grid units"),
        (lambda k: k - 0.1, r"a knot lies at x = -0\.1, allowed is 0 to 3 grid units"),
        (lambda k: k[:, [0, 2, 1]], "horizontal fibre 1: knots do not ascend"),
        (lambda k: np.concatenate([k[:3], k[3:, [0, 2, 1]]]), "vertical fibre 2: knots do not ascend"),
        (lambda k: np.where(np.arange(3)[:, None] == 0, k + 0.1, k), "must run from"),
    ],
)
def test_wrong_knots_are_refused_by_name(change, message):
    knots = Morphology.random(2, 1, seed=0).knots
    with pytest.raises(InputError, match=message):
        Morphology(change(knots))


@pytest.mark.parametrize("pitch", [0, -1, np.nan, np.inf, 1e9])
def test_an_impossible_pitch_is_refused(pitch):
    with pytest.raises(InputError, match="pitch_mm"):
        Morphology.straight(2, pitch)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": "other/1"}', '{"format": "padforge-morphology/1"}', "\x00\xff"]
)
def test_files_that_hold_no_morphology_are_refused_on_one_line(tmp_path, text):
    path = tmp_path / "pad.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"pad\.json") as refusal:
        Morphology.load(path)
    assert "\n" not in str(refusal.value)


def test_frames_convert_both_ways():
    pad = Morphology.straight(4)
    assert pad.to_mm([2.5, 2.5]) == pytest.approx([0, 0])
    assert pad.to_grid(pad.to_mm([[1.0, 4.0]])) == pytest.approx(np.array([[1.0, 4.0]]))


@pytest.mark.parametrize(("name", "knots"), [("1para", 1), ("5para_dis", 5), ("20para", 20), ("square_grid_cir", 0)])
def test_published_files_load_and_the_square_grid_is_recognised(published, name, knots):
    pad = Morphology.load(published / f"{name}.mat")
    assert pad.knots.shape == (8, knots + 2, 2)
    assert pad.pitch_mm == 11.25


def test_a_torn_published_file_is_refused(published, tmp_path):
    torn = tmp_path / "torn.mat"
    torn.write_bytes((published / "5para_dis.mat").read_bytes()[:20_000])
    with pytest.raises(InputError, match=r"torn\.mat") as refusal:
        Morphology.load(torn)
    assert "\n" not in str(refusal.value)


def test_a_recording_is_no_morphology(published):
    with pytest.raises(InputError, match="no variable para"):
        Morphology.load(published / "para5_long_first4500.mat")


@pytest.mark.parametrize(("grid", "knots"), [(0, 1), (-1, 2), (2, -1)])
def test_impossible_counts_are_refused(grid, knots):
    with pytest.raises(InputError, match="allowed is a whole number from"):
        Morphology.random(grid, knots)


@pytest.mark.parametrize("pitch", ["1" + "0" * 400, "[" * 100_000])
def test_numbers_and_nesting_beyond_measure_are_refused(tmp_path, pitch):
    path = tmp_path / "pad.json"
    path.write_text('{"format": "padforge-morphology/1", "knots": [], "pitch_mm": ' + pitch + "}")
    with pytest.raises(InputError, match=r"pad\.json"):
        Morphology.load(path)


def test_a_pad_repeated_as_tiles_answers_alike_in_each_of_them():
    tile = Morphology.random(3, 4, seed=2, pitch_mm=5.0)
    pad = tile.tiled(4)
    assert (pad.grid, pad.pitch_mm) == (12, 5.0)
    places = np.random.default_rng(0).uniform(3.6, 6.4, (50, 2))
    answers = signals(pad, places, PUBLISHED_CONTACT).reshape(50, 2, 4, 3)
    moved = signals(pad, places + np.array([3, 0]), PUBLISHED_CONTACT).reshape(50, 2, 4, 3)
    # One tile to the right: the same horizontals, the verticals of the next tile.
    np.testing.assert_allclose(moved[:, 0], answers[:, 0], atol=1e-9)
    np.testing.assert_allclose(moved[:, 1, 1:], answers[:, 1, :-1], atol=1e-9)


def test_straight_fibres_repeated_are_straight_fibres():
    places = np.random.default_rng(1).uniform(1, 8, (40, 2))
    tiled, straight = Morphology.straight(2).tiled(4), Morphology.straight(8)
    np.testing.assert_allclose(signals(tiled, places), signals(straight, places), atol=1e-12)


@pytest.mark.parametrize("times", [0, 1.5, 10**4])
def test_tiles_beyond_reason_are_refused(times):
    with pytest.raises(InputError, match=r"times is .*, allowed is a whole number from 1 to 256"):
        Morphology.straight(4).tiled(times)


@pytest.mark.parametrize(
    "settings",
    [
        {"K": {"str_shp": 30, "fineness": 100}},
        {"K": {"object_size": -1, "str_shp": 30, "fineness": 100}},
        {"sens_raw_all": np.ones((5, 7))},
        {"loc_all": np.ones((2, 2, 8))},
        {"loc_all": ""},
        {"K": 3},
    ],
)
def test_published_samples_that_are_not_as_published_are_one_line(settings, tmp_path):
    content = {
        "para": np.random.default_rng(0).uniform(0.5, 2.5, (3, 8)),
        "K": {"object_size": 0.6, "str_shp": 30, "fineness": 100},
        "loc_all": np.ones((5, 2)),
        "sens_raw_all": np.ones((5, 4)),
    }
    path = tmp_path / "pad.mat"
    scipy.io.savemat(path, content)
    assert Morphology.load(path).grid == 2
    scipy.io.savemat(path, content | settings)
    with pytest.raises(InputError, match="not as published") as refused:
        Morphology.load(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("para", [np.empty((0, 0)), np.ones((2, 8)) * 1j])
def test_parameters_of_another_kind_are_refused(para):
    with pytest.raises(InputError, match="parameters"):
        Morphology.from_parameters(para)


@pytest.mark.parametrize("other", [None, 3, "a", np.ones((2, 2)), [1], {1: 2}])
def test_a_document_or_layout_of_another_kind_is_one_line(other):
    pad = Morphology.straight(1)
    with pytest.raises(InputError, match=r"document is .*, expected a table"):
        Morphology.of_document(other)
    with pytest.raises(InputError, match=r"layout is .*, expected a Layout"):
        Morphology.of_layout(pad.knots, other)
    with pytest.raises(InputError, match="provenance"):
        Morphology.of_layout(pad.knots, pad.layout, 0 if other is None else other)  # pyright: ignore
