"""The trained localizer: failed fibres are ignored, radii follow, predictions are written as CSV."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.localizer.model import (
    UNIFORM,
    Localization,
    LocalizerModel,
    MeasureEstimate,
    concatenate,
    write_localization,
)
from padforge.sense.localizer.scaler import ScaledFeatures


def test_predict_ignores_failed_fibres(localizer: LocalizerModel, recording: Recording) -> None:
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


def test_predict_widens_radii_with_fewer_fibres(localizer: LocalizerModel, recording: Recording) -> None:
    readings = np.array(recording.readings)
    readings[recording.down_command[7] - 15 : recording.up_command[7] + 25] = np.nan
    found = localizer.predict_features(localizer.scaled_features(replace(recording, readings=readings)))
    assert found.positions_mm[7] == pytest.approx(localizer.scaler.origin_mm)
    assert found.r50_mm[7] < found.r90_mm[7]
    assert found.r50_mm[7] > 0.5 * localizer.scaler.scale_mm
    assert np.isfinite(found.positions_mm).all()
    far = np.hypot(*np.random.default_rng(0).uniform(-1, 1, (2, 200_000)))
    assert np.mean(far <= UNIFORM[1]) == pytest.approx(0.5, abs=0.005)
    assert np.mean(far <= UNIFORM[2]) == pytest.approx(0.9, abs=0.005)
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
        ([4], "failed is .4., expected indices of fibres, 0 to 3"),
        ([True], "failed is .*, expected indices"),
        ([0, 1, 2, 3], "all 4 fibres"),
    ],
)
def test_predict_refuses_unknown_fibres(
    localizer: LocalizerModel, recording: Recording, lost: list[Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        localizer.predict_features(localizer.scaled_features(recording), lost)


def test_predict_refuses_other_pads(localizer: LocalizerModel, recording: Recording) -> None:
    with pytest.raises(InputError, match="3 fibres, the localizer was learnt from 4"):
        localizer.scaled_features(replace(recording, readings=recording.readings[:, :3]))


def test_predict_takes_rates_within_a_quarter(localizer: LocalizerModel, recording: Recording) -> None:
    for ratio in (0.76, 1.24):
        presses = localizer.scaled_features(replace(recording, times_s=recording.times_s / ratio))
        assert np.isfinite(localizer.predict_features(presses).positions_mm).all()
    for ratio in (0.74, 1.26):
        with pytest.raises(InputError, match="readings a second"):
            localizer.scaled_features(replace(recording, times_s=recording.times_s / ratio))


def test_predict_gives_intervals_of_depth_and_force(deep_localizer: LocalizerModel, deep_recording: Recording) -> None:
    presses = deep_localizer.scaled_features(deep_recording)
    whole, fewer = (deep_localizer.predict_features(presses, lost).measures for lost in ((), (1, 2)))
    assert list(whole) == ["depth_mm", "force_n"]
    assert np.corrcoef(whole["depth_mm"].values, deep_recording.depths_mm)[0, 1] > 0.95
    np.testing.assert_allclose(whole["force_n"].values, 3 * whole["depth_mm"].values, atol=2)
    assert (whole["depth_mm"].r90 > 0).all()
    assert fewer["depth_mm"].r90.mean() > whole["depth_mm"].r90.mean()
    blind = ScaledFeatures(presses.inputs, np.zeros_like(presses.fibre_mask))
    depth = deep_localizer.predict_features(blind).measures["depth_mm"]
    assert depth.values == pytest.approx(2.75, abs=0.05)
    assert depth.r90 == pytest.approx(2.25, abs=0.05)
    found = concatenate([deep_localizer.predict_features(presses[:5]), deep_localizer.predict_features(presses[5:9])])
    expected = deep_localizer.predict_features(presses[:9])
    np.testing.assert_allclose(found.positions_mm, expected.positions_mm, atol=1e-3)
    np.testing.assert_allclose(found.measures["force_n"].r90, expected.measures["force_n"].r90, rtol=1e-3)


def test_write_localization_writes_one_line_a_press(tmp_path: Path) -> None:
    places, sd = np.array([[1.23456, -2.0], [0.0, 3.5]]), np.array([[0.5, 0.25], [1.0, 2.0]])
    plain = Localization(places, sd, np.array([0.4, 1.5]), np.ones(2) * 3)
    write_localization(plain, tmp_path / "places.csv")
    assert (tmp_path / "places.csv").read_text().splitlines() == [
        "press,x_mm,y_mm,std_x_mm,std_y_mm,r50_mm,r90_mm",
        "0,1.2346,-2.0000,0.5000,0.2500,0.4000,3.0000",
        "1,0.0000,3.5000,1.0000,2.0000,1.5000,3.0000",
    ]
    force = MeasureEstimate(np.array([7.0, 8.0]), np.ones(2))
    deep = replace(
        plain, measures={"depth_mm": MeasureEstimate(np.array([1.25, 2]), np.array([0.5, 1])), "force_n": force}
    )
    write_localization(deep, tmp_path / "places.csv")
    header, line, _ = (tmp_path / "places.csv").read_text().splitlines()
    assert header.endswith("r90_mm,depth_mm,depth_r90_mm,force_n,force_r90_n")
    assert line.endswith("3.0000,1.2500,0.5000,7.0000,1.0000")
    with pytest.raises(InputError, match="cannot be written"):
        write_localization(plain, tmp_path)
