"""The localizer: masks hide, a press that no fibre tells may be anywhere, files keep every bit."""

import os
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Localizer, Recording
from sense.localizer.features import SIZES
from sense.localizer.localizer import joined
from sense.localizer.normalization import Scaled
from tools.kills import killed


def test_a_masked_fibre_changes_nothing(localizer: Localizer, recording: Recording) -> None:
    presses = localizer.inputs(recording)
    spoilt = presses.inputs.copy()
    spoilt[:, 1] = np.nan
    masked = localizer.locate(presses, [1])
    assert np.array_equal(localizer.locate(Scaled(spoilt, presses.alive), [1]).places_mm, masked.places_mm)
    assert not np.array_equal(masked.places_mm, localizer.locate(presses).places_mm)


def test_a_fibre_that_gave_no_readings_is_as_good_as_masked(localizer: Localizer, recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[:, 1] = np.nan
    found = localizer.locate(localizer.inputs(replace(recording, readings=readings)))
    expected = localizer.locate(localizer.inputs(recording), [1])
    assert np.array_equal(found.places_mm, expected.places_mm)
    assert np.array_equal(found.r90_mm, expected.r90_mm)


def test_a_press_without_any_fibre_may_be_anywhere(localizer: Localizer, recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[recording.begun[7] - 15 : recording.lifted[7] + 25] = np.nan
    found = localizer.locate(localizer.inputs(replace(recording, readings=readings)))
    assert found.places_mm[7] == pytest.approx(localizer.normalization.middle_mm)
    assert found.r50_mm[7] < found.r90_mm[7]
    assert found.r50_mm[7] > 0.5 * localizer.normalization.span_mm
    assert np.isfinite(found.places_mm).all()


def test_the_radii_of_a_press_anywhere_hold_what_they_say() -> None:
    from sense.localizer.localizer import UNKNOWN

    far = np.hypot(*np.random.default_rng(0).uniform(-1, 1, (2, 200_000)))
    assert np.mean(far <= UNKNOWN[1]) == pytest.approx(0.5, abs=0.005)
    assert np.mean(far <= UNKNOWN[2]) == pytest.approx(0.9, abs=0.005)


def test_a_press_is_located_alone_as_among_others(localizer: Localizer, recording: Recording) -> None:
    presses = localizer.inputs(recording)
    found = localizer.locate(presses)
    assert np.allclose(localizer.locate(presses[17:18]).places_mm, found.places_mm[17:18], atol=1e-4)
    assert localizer.locate(presses[:0]).places_mm.shape == (0, 2)


def test_less_is_known_with_fibres_lost(localizer: Localizer, recording: Recording) -> None:
    presses = localizer.inputs(recording)
    means = [localizer.locate(presses, range(lost)).r90_mm.mean() for lost in range(4)]
    assert means[:2] == sorted(means)[:2]
    assert min(means[2:]) > 1.1 * means[0]
    found = localizer.locate(presses)
    assert (found.r50_mm < found.r90_mm).all()
    assert (found.sd_mm > 0).all()


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ([4], "lost fibre at index 4: none, allowed are 0 to 3"),
        ([-1], "lost fibre at index -1"),
        ([0, 1, 2, 3], "all 4 fibres"),
    ],
)
def test_masks_that_cannot_be_are_refused(
    localizer: Localizer, recording: Recording, lost: list[int], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        localizer.locate(localizer.inputs(recording), lost)


def test_files_keep_every_bit(localizer: Localizer, recording: Recording, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    found = Localizer.load(tmp_path)
    assert all(np.array_equal(found.weights[name], weight) for name, weight in localizer.weights.items())
    presses = localizer.inputs(recording)
    assert np.array_equal(found.inputs(recording).inputs, presses.inputs)
    again, before = found.locate(presses, [2]), localizer.locate(presses, [2])
    assert np.array_equal(again.places_mm, before.places_mm)
    assert np.array_equal(again.r90_mm, before.r90_mm)
    assert found.errors == localizer.errors
    assert found.test == localizer.test
    found.save(tmp_path / "again")
    for name in ("localizer.json", "localizer.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_files_that_do_not_belong_together_are_refused(localizer: Localizer, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    weights = tmp_path / "localizer.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])
    with pytest.raises(InputError, match=r"not the weights that localizer\.json was written with"):
        Localizer.load(tmp_path)
    weights.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        Localizer.load(tmp_path)


def test_recordings_that_do_not_suit_are_refused(localizer: Localizer, recording: Recording) -> None:
    fewer = Recording(
        recording.readings[:, :3], recording.times_s, recording.presses_mm, recording.begun, recording.lifted
    )
    with pytest.raises(InputError, match="3 fibres, the localizer was learnt from 4"):
        localizer.inputs(fewer)
    faster = Recording(
        recording.readings, recording.times_s / 2, recording.presses_mm, recording.begun, recording.lifted
    )
    with pytest.raises(InputError, match="readings a second"):
        localizer.inputs(faster)


@pytest.mark.parametrize(("ratio", "suits"), [(0.74, False), (0.76, True), (1.24, True), (1.26, False)])
def test_a_recording_is_up_to_a_quarter_faster_or_slower(
    localizer: Localizer, recording: Recording, ratio: float, suits: bool
) -> None:
    other = replace(recording, times_s=recording.times_s / ratio)
    if suits:
        assert np.isfinite(localizer.locate(localizer.inputs(other)).places_mm).all()
    else:
        with pytest.raises(InputError, match="readings a second"):
            localizer.inputs(other)


@pytest.mark.parametrize(
    "change",
    [
        lambda w: {**w, "last.b": w["last.b"] * np.float32(np.nan)},
        lambda w: {**w, "first.w": w["first.w"] + np.float32(1e30)},
        lambda w: {**w, "first.w": w["first.w"][:, 1:]},
        lambda w: {**w, "first.w": w["first.w"][:0]},
        lambda w: {**w, "hidden.b": w["hidden.b"].astype(np.float64)},
        lambda w: {name: weight for name, weight in w.items() if name != "last.w"},
        lambda w: {},
    ],
)
def test_weights_that_do_not_fit_the_document_are_refused(localizer: Localizer, tmp_path: Path, change) -> None:
    replace(localizer, weights=change(dict(localizer.weights))).save(tmp_path)
    with pytest.raises(InputError, match=r"localizer\.safetensors: no weights of the localizer"):
        Localizer.load(tmp_path)


@pytest.mark.parametrize("value", [np.nan, object()])
def test_a_save_that_fails_leaves_the_model_that_was_there(localizer: Localizer, tmp_path: Path, value: object) -> None:
    localizer.save(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = {name: weight + 1 for name, weight in localizer.weights.items()}
    with pytest.raises(InputError, match="cannot be written as JSON"):
        replace(localizer, weights=other, provenance={"note": value}).save(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_save_into_a_place_that_is_taken_changes_nothing(localizer: Localizer, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    (tmp_path / "localizer.json").unlink()
    (tmp_path / "localizer.json").mkdir()
    before = (tmp_path / "localizer.safetensors").read_bytes()
    with pytest.raises(InputError, match="is a folder, expected a file or nothing"):
        replace(localizer, weights={name: weight + 1 for name, weight in localizer.weights.items()}).save(tmp_path)
    assert (tmp_path / "localizer.safetensors").read_bytes() == before
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        localizer.save(tmp_path / "file")


@pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")
def test_a_kill_at_any_moment_of_a_save_leaves_the_old_or_the_new_localizer(
    localizer: Localizer, tmp_path: Path
) -> None:
    later = replace(localizer, weights={name: weight + 1 for name, weight in localizer.weights.items()})
    name, found = next(iter(localizer.weights)), []
    for number in count():
        folder = tmp_path / str(number)
        replace(localizer, split="random").save(folder)
        ended = not killed(lambda folder=folder: replace(later, split="chronological").save(folder), number, folder)
        loaded = Localizer.load(folder)
        is_new = np.array_equal(loaded.weights[name], later.weights[name])
        assert is_new == (loaded.split == "chronological")
        found.append(is_new)
        if ended:
            break
    assert (found[0], found[-1]) == (False, True)


@pytest.mark.parametrize("lost", [[10**20], [0.5], [True], ["a"]])
def test_a_mask_that_is_no_index_is_refused(localizer: Localizer, recording: Recording, lost: list) -> None:
    with pytest.raises(InputError, match=r"lost fibre at index .*: none, allowed are 0 to 3"):
        localizer.locate(localizer.inputs(recording), lost)


def test_readings_far_from_all_learnt_ones_give_finite_places(localizer: Localizer, recording: Recording) -> None:
    readings = 1000.0 * np.random.default_rng(0).choice([-1, 1], recording.readings.shape)
    spread = np.full_like(localizer.normalization.spread, 1e-40)
    still = replace(localizer.normalization, spread=spread, middle_mm=np.zeros(2), span_mm=1e5)
    found = replace(localizer, normalization=still)
    places = found.locate(found.inputs(replace(recording, readings=readings)))
    assert np.isfinite(places.places_mm).all()
    assert np.isfinite(places.r90_mm).all()


def test_depth_and_force_come_with_widths_that_grow_as_fibres_are_lost(
    deep_localizer: Localizer, deep_recording: Recording
) -> None:
    presses = deep_localizer.inputs(deep_recording)
    whole, fewer = (deep_localizer.locate(presses, lost).measures for lost in ((), (1, 2)))
    assert list(whole) == ["depth_mm", "force_n"]
    assert np.corrcoef(whole["depth_mm"].values, deep_recording.depths_mm)[0, 1] > 0.95
    np.testing.assert_allclose(whole["force_n"].values, 3 * whole["depth_mm"].values, atol=2)
    assert (whole["depth_mm"].r90 > 0).all()
    assert fewer["depth_mm"].r90.mean() > whole["depth_mm"].r90.mean()


def test_a_press_without_any_fibre_may_be_of_any_depth(deep_localizer: Localizer, deep_recording: Recording) -> None:
    presses = deep_localizer.inputs(deep_recording)
    depth = deep_localizer.locate(Scaled(presses.inputs, np.zeros_like(presses.alive))).measures["depth_mm"]
    assert depth.values == pytest.approx(2.75, abs=0.05)
    assert depth.r90 == pytest.approx(2.25, abs=0.05)


def test_what_was_learnt_beside_the_place_survives_its_files(
    deep_localizer: Localizer, deep_recording: Recording, tmp_path: Path
) -> None:
    deep_localizer.save(tmp_path)
    again = Localizer.load(tmp_path)
    assert again.normalization.measures == deep_localizer.normalization.measures
    assert again.errors == deep_localizer.errors
    presses = deep_localizer.inputs(deep_recording)
    found = again.locate(presses).measures
    for name, before in deep_localizer.locate(presses).measures.items():
        assert np.array_equal(before.values, found[name].values)
        assert np.array_equal(before.r90, found[name].r90)


def test_parts_are_joined_press_by_press(deep_localizer: Localizer, deep_recording: Recording) -> None:
    presses = deep_localizer.inputs(deep_recording)
    found = joined([deep_localizer.locate(presses[:5]), deep_localizer.locate(presses[5:9])])
    expected = deep_localizer.locate(presses[:9])
    np.testing.assert_allclose(found.places_mm, expected.places_mm, atol=1e-3)
    np.testing.assert_allclose(found.measures["force_n"].r90, expected.measures["force_n"].r90, rtol=1e-3)


@pytest.mark.parametrize("folder", [None, 3, ["a"], np.ones(3), ""])
def test_a_model_is_kept_in_a_folder_and_nothing_else(localizer: Localizer, folder: Any) -> None:
    with pytest.raises(InputError, match=r"folder is .*, expected a path"):
        Localizer.load(folder)
    with pytest.raises(InputError, match=r"folder is .*, expected a path"):
        localizer.save(folder)


def test_what_are_no_inputs_of_presses_is_refused(localizer: Localizer, recording: Recording) -> None:
    with pytest.raises(InputError, match=r"presses is .*, expected a Scaled"):
        localizer.locate(recording)  # pyright: ignore[reportArgumentType]


def test_a_localizer_that_knows_no_gains_is_read_and_finds_places(
    localizer: Localizer, recording: Recording, tmp_path: Path
) -> None:
    """As all were that learnt before there were any."""
    scaling, windows = localizer.normalization, SIZES[localizer.features]
    assert scaling.centre.shape[1] > windows
    plain = replace(
        scaling,
        centre=scaling.centre[:, :windows],
        spread=scaling.spread[:, :windows],
        memory=scaling.memory[:, :, :windows],
    )
    by_input = localizer.weights["first.w"][:, : scaling.centre.size]
    by_fibre = by_input.reshape(len(by_input), *scaling.centre.shape, -1)[:, :, :windows]
    alive = localizer.weights["first.w"][:, scaling.centre.size :]
    first = np.concatenate([by_fibre.reshape(len(by_input), plain.centre.size, -1), alive], axis=1)
    before = replace(
        localizer,
        normalization=plain,
        table=np.ascontiguousarray(localizer.table[..., :windows]),
        weights={**localizer.weights, "first.w": first},
        observer=None,
        corrector={},
    )
    before.save(tmp_path)
    found = Localizer.load(tmp_path).locate(before.inputs(recording))
    assert np.array_equal(found.places_mm, before.locate(before.inputs(recording)).places_mm)
    off = np.hypot(*(found.places_mm - localizer.locate(localizer.inputs(recording)).places_mm).T)
    assert 0 < np.median(off) < 0.1 * scaling.span_mm
