"""The trained localizer: failed fibres, radii, files that keep every bit; and its recalibration to a changed pad."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.design import Morphology
from padforge.sense import Recording, simulate
from padforge.sense.localizer import recalibration, single_press, training
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.model import UNIFORM, Localization, LocalizerModel, MeasureEstimate, write_localization
from padforge.sense.localizer.recalibration import CrossValidation, Recalibration, recalibrate
from padforge.sense.localizer.response_model import interpolate_grid
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.built_pad import build_pad
from tests.helpers.constants import with_constants
from tests.helpers.door import called
from tests.helpers.golden import json_text
from tests.helpers.presses import changed


def test_predict_ignores_failed_fibres(localizer: LocalizerModel, recording: Recording) -> None:
    presses = localizer.scaled_features(recording)
    spoilt = presses.inputs.copy()
    spoilt[:, 1] = np.nan
    masked = localizer.predict_features(presses, [1])
    found = localizer.predict_features(replace(presses, inputs=spoilt), [1])
    assert np.array_equal(found.positions_mm, masked.positions_mm)
    assert not np.array_equal(masked.positions_mm, localizer.predict_features(presses).positions_mm)
    missing = changed(recording, "readings", np.s_[:, 1], np.nan)
    found = localizer.predict_features(localizer.scaled_features(missing))
    assert np.array_equal(found.positions_mm, masked.positions_mm)
    assert np.array_equal(found.r90_mm, masked.r90_mm)


def test_predict_widens_radii_with_fewer_fibres(localizer: LocalizerModel, recording: Recording) -> None:
    seventh = slice(recording.down_command[7] - 15, recording.up_command[7] + 25)
    found = localizer.predict_features(localizer.scaled_features(changed(recording, "readings", seventh, np.nan)))
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


def test_fibre_names_and_plans_are_compared_where_known(localizer: LocalizerModel, recording: Recording) -> None:
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
def test_files_keep_every_bit(fixture: str, deep_recording: Recording, tmp_path, request) -> None:
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


OLD = RigSettings(seed=1)  # of the pad of the fixture `recording`
ANGLE, SHIFT = np.deg2rad(3.0), np.array([1.5, -1.0])
GAINS = np.array([0.8, 1.2, 1.1, 0.9])


def remade(recording: Recording) -> Recording:
    """The same presses on a pad whose fibres answer by other factors, and which lies shifted and turned."""
    turn = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
    return replace(recording, readings=recording.readings * GAINS, presses_mm=recording.presses_mm @ turn.T + SHIFT)


def known_only(recording: Recording, presses: slice) -> Recording:
    return changed(recording, "presses_mm", slice(presses.stop, None), np.nan)


def error(localizer: LocalizerModel, recording: Recording, presses: slice, lost: tuple[int, ...] = ()) -> float:
    found = localizer.predict_features(localizer.scaled_features(recording)[presses], lost)
    return float(distances(found.positions_mm, recording.presses_mm[presses]).mean())


NEW, LATER = slice(0, 50), slice(60, 300)


# few folds, and one set of failed fibres of a size, tell as much of a change
sets = [(module, {"SUBSETS": 1}) for module in (recalibration, single_press)]
short = with_constants((training, {"RETRAINING_STEPS": 12}), (recalibration, {"FOLDS": 3}), *sets)


def off_by(*amounts: float) -> Localization:
    """Presses in the middle, found to the side by so many mm."""
    ones = np.ones(len(amounts))
    return Localization(np.column_stack([amounts, 0 * ones]), np.ones((len(amounts), 2)), ones, ones)


def test_cross_validation_compares_presses_left_out() -> None:
    """With all fibres errors shrink by 1, 2, 3, 4 mm, with one lost by 0 and by 4 mm: by 1.5 to 3 in the mean."""
    before = [[off_by(2, 4, 6, 8)], [off_by(5, 5, 5, 5), off_by(5, 5, 5, 5)]]
    after = [[off_by(1, 2, 3, 4)], [off_by(5, 5, 5, 5), off_by(1, 1, 1, 1)]]
    presses: Any = np.arange(4), np.zeros((4, 2)), {}
    validation: Any = CrossValidation(presses, 2, [[()], [(0,), (1,)]])
    gain, error = validation.gain(before, after)
    assert gain == pytest.approx(2.25)
    assert error == pytest.approx(np.std([1.5, 2.0, 2.5, 3.0], ddof=1) / 2)
    row = {"change": "refitted", "mean_mm": pytest.approx(2.75), "standard_error_mm": error}
    assert validation.candidate("refitted", before, after) == row
    found = [[off_by(0.1, 0.1, 0.1, 0.1)], [off_by(3, 3, 3, 3), off_by(3, 3, 3, 3)]]
    widened = validation.widening(found)  # where radii hold, they are not narrowed
    np.testing.assert_allclose(widened, [[1, 1, 1], [3 / np.sqrt(2), 3, 3]])
    seen: list[list[int]] = []

    def change(localizer: int, raw: np.ndarray, positions_mm: np.ndarray, measures: dict[str, np.ndarray]) -> int:
        assert positions_mm.shape == (2, 2)
        seen.append(raw.tolist())
        return localizer + 1

    assert validation.adapt([10, 20], change) == [11, 21]
    assert seen == [[2, 3], [0, 1]]  # a fold is changed by the other presses only


@pytest.mark.slow
def test_recalibrate_follows_a_remade_pad(localizer: LocalizerModel, recording: Recording) -> None:
    now, result = recalibrate(localizer, known_only(remade(recording), NEW))
    pad = remade(recording)
    for lost in ((), (0,), (2,), (1, 3)):
        pairs = ((localizer, pad), (now, pad), (localizer, recording))
        before, after, usual = (error(one, presses, LATER, lost) for one, presses in pairs)
        # Of the error with fibres lost, little is the change's: most of it no recalibration can take away.
        assert after - usual < (1.0 if lost else 0.3) * (before - usual)
    assert (result.change, result.new_fibres) in (("corrected", []), ("refitted", []))
    assert result.gain_mm > 2 * result.standard_error_mm > 0
    shrunk = [old["mean_mm"] - new["mean_mm"] for old, new in zip(result.before, result.after, strict=True)]
    assert min(shrunk) > 0
    assert result.gain_mm == pytest.approx(np.mean(shrunk))  # every number of lost fibres counts alike


@pytest.mark.slow
def test_recalibrate_learns_another_pad_of_the_plan_and_a_new_fibre(localizer, recording, monkeypatch) -> None:
    """Of a pad cast again all fibres are learnt anew; of one fibre that responds as another pad's does, that one."""
    rig = RigSettings(presses=300, seed=2)
    other = simulate(Morphology.from_dict(recording.source["morphology"]), rig)
    now, result = recalibrate(localizer, known_only(other, NEW))
    assert (result.change, result.new_fibres) == ("refitted", [0, 1, 2, 3])
    assert error(now, other, LATER) < 0.6 * error(localizer, other, LATER)
    assert [row["change"] for row in result.candidates] == [None, "corrected", "refitted"]
    assert localizer.is_other_pad(localizer.scaled_features(other)[LATER])
    assert not now.is_other_pad(now.scaled_features(other)[LATER])
    # The same presses on the pad of before, but for one fibre.
    monkeypatch.setattr("padforge.sense.simulation.simulated_recording.build_pad", lambda pad, _: build_pad(pad, OLD))
    mended = simulate(Morphology.from_dict(recording.source["morphology"]), rig)
    mended = changed(mended, "readings", np.s_[:, 2], other.readings[:, 2])
    now, result = recalibrate(localizer, known_only(mended, NEW))
    assert (result.change, result.new_fibres) == ("refitted", [2])
    assert error(now, mended, LATER) < 0.8 * error(localizer, mended, LATER)
    assert error(now, mended, LATER) < error(localizer, mended, LATER, (2,))


def test_recalibrate_keeps_an_unchanged_pad(localizer: LocalizerModel, recording: Recording) -> None:
    """But radii that are too small, which are widened."""
    small = localizer.interval_factors / 2
    old = replace(localizer, recalibrated_by=("of before",), interval_factors=small)
    now, result = recalibrate(old, known_only(recording, NEW))
    assert now.recalibrated_by == ("of before", known_only(recording, NEW).digest)
    assert result.change != "corrected"
    assert result.gain_mm >= 0  # what does not reduce the error is not kept
    assert not result.new_fibres
    np.testing.assert_allclose(now.interval_factors, small * result.widened)
    assert (now.interval_factors >= small).all()
    assert (now.interval_factors > small).mean() > 0.9
    assert error(now, recording, LATER) < 1.03 * error(localizer, recording, LATER)


def test_fit_correction_recovers_gains_and_pose(localizer: LocalizerModel, recording: Recording) -> None:
    scaling, gains, shift = localizer.scaler, np.array([1.2, 0.8, 1.1, 0.9]), np.array([0.06, -0.08])
    turn = 1.02 * np.array([[np.cos(0.05), -np.sin(0.05)], [np.sin(0.05), np.cos(0.05)]])
    pad = replace(recording, readings=recording.readings * gains)
    # Places are those that the localizer itself finds, so that nothing but the correction is to be found.
    places = localizer.predict_features(localizer.scaled_features(recording)).positions_mm
    moved = ((places - scaling.origin_mm) / scaling.scale_mm) @ turn.T + shift
    moved = moved * scaling.scale_mm + scaling.origin_mm
    found = recalibration.fit_correction(localizer, localizer.raw_features(pad), moved)
    np.testing.assert_allclose(found.scaler.scale_v[:, 0] / scaling.scale_v[:, 0], gains, rtol=0.02)
    expected = localizer.scaled_features(recording).inputs
    np.testing.assert_allclose(found.scaled_features(pad).inputs, expected, atol=0.15)
    before, after = (distances(each.predict(pad).positions_mm, moved).mean() for each in (localizer, found))
    assert after < 0.1 * before
    # The table is turned with the pad.
    at = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))
    one, other = (each.table.reshape(*each.table.shape[:2], -1) for each in (localizer, found))
    expected = interpolate_grid(one, at)
    np.testing.assert_allclose(interpolate_grid(other, at @ turn.T + shift), expected, atol=0.05 * np.ptp(expected))


def test_recalibrate_command_writes_nothing_beside_a_broken_detector(model: Path, tmp_path: Path) -> None:
    shutil.copytree(model, tmp_path / "old")
    (tmp_path / "old/health").mkdir()
    (tmp_path / "old/health/commanded.json").write_text("{}")
    ended = called("sense", "recalibrate", "--model", "old", "old/recording", "--out", "new", cwd=tmp_path)
    assert (ended.code, ended.err[:38]) == (2, "padforge: old/health/commanded.json: f")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_recalibrate_follows_depths_known_or_not(deep_localizer: LocalizerModel, deep_recording: Recording) -> None:
    names = ("presses_mm", "down_command", "up_command", "depths_mm", "forces_n")
    few = {name: getattr(deep_recording, name)[:40] for name in names}
    later = replace(deep_recording, **few, reached_mm=np.empty(0))
    now, result = recalibrate(deep_localizer, later)
    assert now.interval_factors.shape == deep_localizer.interval_factors.shape
    assert (now.interval_factors >= deep_localizer.interval_factors).all()
    assert result.after[0]["depth_mean_mm"] < 0.5
    unknown, result = recalibrate(deep_localizer, replace(later, depths_mm=np.empty(0), forces_n=np.empty(0)))
    assert "depth_mean_mm" not in result.after[0]
    depths = unknown.predict_features(unknown.scaled_features(deep_recording)).measures["depth_mm"].values
    assert np.abs(depths - deep_recording.depths_mm).mean() < 0.5


def test_recalibration_is_told_whole(golden: Any) -> None:
    """One that was refitted, one that was corrected, and one that changed nothing: lines and documents."""
    before, after = (
        [
            {"n_failed": n, "subsets": sets, "mean_mm": (1 + n) * mean, "within_r90": share - 0.013 * n}
            for n, sets in ((0, 1), (2, 15))
        ]
        for mean, share in ((3.5, 0.512), (2.0, 0.907))
    )
    candidates = [
        {"change": None, "mean_mm": 3.5, "standard_error_mm": 0.0},
        {"change": "corrected", "mean_mm": 3.41, "standard_error_mm": 0.213},
        {"change": "refitted", "mean_mm": 2.0, "standard_error_mm": 0.126},
    ]
    widened = [[1.0, 1.2, 1.1]]
    refitted = Recalibration(60, "refitted", candidates, [1, 3], 1.753, before, after, 1.5, 0.1264, widened, {})
    corrected = replace(refitted, change="corrected", new_fibres=[], twice_as_many_mm=None, gain_mm=0.0876)
    same = replace(corrected, change=None, after=before, gain_mm=0.0, standard_error_mm=0.0)
    texts = ["\n".join(recalibration.recalibration_lines(each)) for each in (refitted, corrected, same)]
    golden("sense/recalibration/lines.txt", "\n\n".join(texts))
    golden("sense/recalibration/recalibration.json", json_text(refitted.to_dict()))
