"""The localizer: masks hide, a press that no fibre tells may be anywhere, places are written as CSV."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.localizer.features import ScaledFeatures
from padforge.sense.localizer.model import UNKNOWN, Localization, LocalizerModel, Measured, joined, write_localization


def test_a_fibre_masked_or_without_readings_does_nothing(localizer: LocalizerModel, recording: Recording) -> None:
    presses = localizer.scaled_features(recording)
    spoilt = presses.inputs.copy()
    spoilt[:, 1] = np.nan
    masked = localizer.predict_features(presses, [1])
    assert np.array_equal(
        localizer.predict_features(ScaledFeatures(spoilt, presses.fibre_mask), [1]).positions_mm, masked.positions_mm
    )
    assert not np.array_equal(masked.positions_mm, localizer.predict_features(presses).positions_mm)
    readings = np.array(recording.readings)
    readings[:, 1] = np.nan
    found = localizer.predict_features(localizer.scaled_features(replace(recording, readings=readings)))
    assert np.array_equal(found.positions_mm, masked.positions_mm)
    assert np.array_equal(found.r90_mm, masked.r90_mm)


def test_less_is_known_with_fibres_lost_and_nothing_without_any(
    localizer: LocalizerModel, recording: Recording
) -> None:
    readings = np.array(recording.readings)
    readings[recording.down_command[7] - 15 : recording.up_command[7] + 25] = np.nan
    found = localizer.predict_features(localizer.scaled_features(replace(recording, readings=readings)))
    assert found.positions_mm[7] == pytest.approx(localizer.scaler.origin_mm)
    assert found.r50_mm[7] < found.r90_mm[7]
    assert found.r50_mm[7] > 0.5 * localizer.scaler.span_mm
    assert np.isfinite(found.positions_mm).all()
    far = np.hypot(*np.random.default_rng(0).uniform(-1, 1, (2, 200_000)))
    assert np.mean(far <= UNKNOWN[1]) == pytest.approx(0.5, abs=0.005)
    assert np.mean(far <= UNKNOWN[2]) == pytest.approx(0.9, abs=0.005)
    presses = localizer.scaled_features(recording)
    means = [localizer.predict_features(presses, range(lost)).r90_mm.mean() for lost in range(4)]
    assert means[:2] == sorted(means)[:2]
    assert min(means[2:]) > 1.1 * means[0]
    found = localizer.predict_features(presses)
    assert (found.r50_mm < found.r90_mm).all()
    assert (found.std_mm > 0).all()
    # alone as among others
    assert np.allclose(localizer.predict_features(presses[17:18]).positions_mm, found.positions_mm[17:18], atol=1e-4)
    assert localizer.predict_features(presses[:0]).positions_mm.shape == (0, 2)


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ([4], "lost fibre at index 4: none, allowed are 0 to 3"),
        *(([fibre], "lost fibre at index .*: none") for fibre in (-1, 10**20, 0.5, True, "a")),
        ([0, 1, 2, 3], "all 4 fibres"),
    ],
)
def test_bad_masks_are_refused(localizer: LocalizerModel, recording: Recording, lost: list[Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        localizer.predict_features(localizer.scaled_features(recording), lost)


def test_what_are_no_inputs_of_its_presses_is_refused(localizer: LocalizerModel, recording: Recording) -> None:
    with pytest.raises(InputError, match=r"presses is .*, expected a Scaled"):
        localizer.predict_features(recording)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="3 fibres, the localizer was learnt from 4"):
        localizer.scaled_features(replace(recording, readings=recording.readings[:, :3]))


def test_a_recording_is_up_to_a_quarter_faster_or_slower(localizer: LocalizerModel, recording: Recording) -> None:
    for ratio in (0.76, 1.24):
        presses = localizer.scaled_features(replace(recording, times_s=recording.times_s / ratio))
        assert np.isfinite(localizer.predict_features(presses).positions_mm).all()
    for ratio in (0.74, 1.26):
        with pytest.raises(InputError, match="readings a second"):
            localizer.scaled_features(replace(recording, times_s=recording.times_s / ratio))


def test_depth_and_force_come_with_widths_that_grow(deep_localizer: LocalizerModel, deep_recording: Recording) -> None:
    presses = deep_localizer.scaled_features(deep_recording)
    whole, fewer = (deep_localizer.predict_features(presses, lost).measures for lost in ((), (1, 2)))
    assert list(whole) == ["depth_mm", "force_n"]
    assert np.corrcoef(whole["depth_mm"].values, deep_recording.depths_mm)[0, 1] > 0.95
    np.testing.assert_allclose(whole["force_n"].values, 3 * whole["depth_mm"].values, atol=2)
    assert (whole["depth_mm"].r90 > 0).all()
    assert fewer["depth_mm"].r90.mean() > whole["depth_mm"].r90.mean()
    depth = deep_localizer.predict_features(ScaledFeatures(presses.inputs, np.zeros_like(presses.fibre_mask))).measures[
        "depth_mm"
    ]
    assert depth.values == pytest.approx(2.75, abs=0.05)
    assert depth.r90 == pytest.approx(2.25, abs=0.05)
    found = joined([deep_localizer.predict_features(presses[:5]), deep_localizer.predict_features(presses[5:9])])
    expected = deep_localizer.predict_features(presses[:9])
    np.testing.assert_allclose(found.positions_mm, expected.positions_mm, atol=1e-3)
    np.testing.assert_allclose(found.measures["force_n"].r90, expected.measures["force_n"].r90, rtol=1e-3)


def test_places_are_written_one_line_a_press(tmp_path: Path) -> None:
    places, sd = np.array([[1.23456, -2.0], [0.0, 3.5]]), np.array([[0.5, 0.25], [1.0, 2.0]])
    plain = Localization(places, sd, np.array([0.4, 1.5]), np.ones(2) * 3)
    write_localization(plain, tmp_path / "places.csv")
    assert (tmp_path / "places.csv").read_text().splitlines() == [
        "press,x_mm,y_mm,sd_x_mm,sd_y_mm,r50_mm,r90_mm",
        "0,1.2346,-2.0000,0.5000,0.2500,0.4000,3.0000",
        "1,0.0000,3.5000,1.0000,2.0000,1.5000,3.0000",
    ]
    force = Measured(np.array([7.0, 8.0]), np.ones(2))
    deep = replace(plain, measures={"depth_mm": Measured(np.array([1.25, 2]), np.array([0.5, 1])), "force_n": force})
    write_localization(deep, tmp_path / "places.csv")
    header, line, _ = (tmp_path / "places.csv").read_text().splitlines()
    assert header.endswith("r90_mm,depth_mm,depth_r90_mm,force_n,force_r90_n")
    assert line.endswith("3.0000,1.2500,0.5000,7.0000,1.0000")
    with pytest.raises(InputError, match="cannot be written"):
        write_localization(plain, tmp_path)
