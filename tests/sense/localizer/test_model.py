"""The trained localizer: failed fibres are ignored, radii follow; its files keep every bit, or are refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.localizer.model import UNIFORM, Localization, LocalizerModel, MeasureEstimate, write_localization


def test_predict_ignores_failed_fibres(localizer: LocalizerModel, recording: Recording) -> None:
    presses = localizer.scaled_features(recording)
    spoilt = presses.inputs.copy()
    spoilt[:, 1] = np.nan
    masked = localizer.predict_features(presses, [1])
    assert np.array_equal(
        localizer.predict_features(replace(presses, inputs=spoilt), [1]).positions_mm, masked.positions_mm
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
    assert [np.mean(far <= radius) for radius in UNIFORM[1:]] == pytest.approx([0.5, 0.9], abs=0.005)
    untouched = localizer.predict(recording, until=recording.down_command)  # no window is complete
    np.testing.assert_allclose(untouched.positions_mm, np.tile(localizer.scaler.origin_mm, (300, 1)), atol=1e-5)
    assert (untouched.r90_mm > localizer.scaler.scale_mm).all()
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


def test_names_of_fibres_and_plans_of_pads_are_compared_where_both_are_known(
    localizer: LocalizerModel, recording: Recording
) -> None:
    learnt = replace(localizer, fibre_names=("c1", "c2", "c3", "c4"))

    def named(*names: str) -> Recording:
        return replace(recording, source={"fibre_names": list(names)})

    for names in ((), ("c1", "c2", "c3", "c5")):
        learnt.check_recording(named(*names))
    localizer.check_recording(named("c1", "c3", "c2", "c4"))  # it knows no names
    assert localizer.pad_sha256 == recording.pad_digest != ""
    plan = recording.source["morphology"]
    knots = [[[value + 1e-9 for value in row] for row in fibre] for fibre in plan["knots"]]
    localizer.check_recording(replace(recording, source={"morphology": plan | {"knots": knots}}))
    localizer.check_recording(replace(recording, source={}))  # an imported one does not know


def test_predict_gives_intervals_of_depth_and_force(deep_localizer: LocalizerModel, deep_recording: Recording) -> None:
    presses = deep_localizer.scaled_features(deep_recording)
    whole, fewer = (deep_localizer.predict_features(presses, lost).measures for lost in ((), (1, 2)))
    assert list(whole) == ["depth_mm", "force_n"]
    assert np.corrcoef(whole["depth_mm"].values, deep_recording.depths_mm)[0, 1] > 0.95
    np.testing.assert_allclose(whole["force_n"].values, 3 * whole["depth_mm"].values, atol=2)
    assert (whole["depth_mm"].r90 > 0).all()
    assert fewer["depth_mm"].r90.mean() > whole["depth_mm"].r90.mean()
    blind = replace(presses, fibre_mask=np.zeros_like(presses.fibre_mask))
    depth = deep_localizer.predict_features(blind).measures["depth_mm"]
    assert depth.values == pytest.approx(2.75, abs=0.05)
    assert depth.r90 == pytest.approx(2.25, abs=0.05)


def test_write_localization_writes_one_line_a_press(tmp_path: Path) -> None:
    places, sd = np.array([[1.23456, -2.0], [0.0, 3.5]]), np.array([[0.5, 0.25], [1.0, 2.0]])
    measures = {"depth_mm": MeasureEstimate(np.array([1.25, 2]), np.array([0.5, 1]))}
    measures |= {"force_n": MeasureEstimate(np.array([7.0, 8.0]), np.ones(2))}
    found = Localization(places, sd, np.array([0.4, 1.5]), np.ones(2) * 3, measures, np.array([True, False]))
    write_localization(found, tmp_path / "places.csv")
    assert (tmp_path / "places.csv").read_text().splitlines() == [
        "press,x_mm,y_mm,std_x_mm,std_y_mm,r50_mm,r90_mm,unlike,depth_mm,depth_r90_mm,force_n,force_r90_n",
        "0,1.2346,-2.0000,0.5000,0.2500,0.4000,3.0000,1,1.2500,0.5000,7.0000,1.0000",
        "1,0.0000,3.5000,1.0000,2.0000,1.5000,3.0000,0,2.0000,1.0000,8.0000,1.0000",
    ]


@pytest.mark.parametrize("fixture", ["localizer", "deep_localizer"])
def test_save_keeps_every_bit(
    fixture: str, deep_recording: Recording, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    saved: LocalizerModel = request.getfixturevalue(fixture)
    saved.save(tmp_path)
    loaded = LocalizerModel.load(tmp_path)
    again, before = (each.predict(deep_recording, [2]) for each in (loaded, saved))
    assert np.array_equal(again.positions_mm, before.positions_mm)
    assert np.array_equal(again.r90_mm, before.r90_mm)
    assert list(again.measures) == list(before.measures)
    loaded.save(tmp_path / "again")
    for name in ("localizer.json", "localizer.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_load_refuses_changed_and_torn_files(localizer: LocalizerModel, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    files = {path.suffix: path for path in tmp_path.iterdir()}
    whole = {suffix: path.read_bytes() for suffix, path in files.items()}
    document = json.loads(whole[".json"])
    wrong = (("rate_hz", "13"), ("interval_factors", [[[-1.0]]]), ("test", [-1]), ("more", 1))
    changed = [(json.dumps(document | {key: value}), rf"localizer\.json: {key}") for key, value in wrong]
    changed += [(json.dumps(document | {"format": "padforge-localizer/0"}), "padforge-localizer/0")]
    for suffix, content, message in (
        *((".json", text.encode(), message) for text, message in changed),
        (".json", whole[".json"][:-9], "not a JSON file|JSON"),
        (".safetensors", whole[".safetensors"][:-9], "not the weights"),
    ):
        files[suffix].write_bytes(content)
        with pytest.raises(InputError, match=message):
            LocalizerModel.load(tmp_path)
        files[suffix].write_bytes(whole[suffix])


def test_save_that_fails_changes_nothing(localizer: LocalizerModel, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = replace(localizer, table=localizer.table + 1)
    (tmp_path / "localizer.json").unlink()
    (tmp_path / "localizer.json").mkdir()
    with pytest.raises(InputError, match="is a folder, expected a file or nothing"):
        other.save(tmp_path)
    assert (tmp_path / "localizer.safetensors").read_bytes() == before["localizer.safetensors"]
