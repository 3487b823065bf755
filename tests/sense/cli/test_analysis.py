from pathlib import Path

import pytest

from sense.localizer.calibration import fine_tuning


def test_the_model_given_is_never_written_over_unasked(few, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folder may be that of the new recording too."""
    monkeypatch.setattr(fine_tuning, "STEPS", 15)
    few("record", "--presses", "20", "--seed", "2", "--out", "model/later")
    before = {path.name: path.read_bytes() for path in Path("model").iterdir() if path.is_file()}
    code, out, err = few("recalibrate", "--model", "./model", "model/later")
    assert (code, out) == (2, "")
    assert err == "padforge: model: holds the old model; name a folder for the new one with --out\n"
    assert {path.name: path.read_bytes() for path in Path("model").iterdir() if path.is_file()} == before
    Path("later").mkdir()
    Path("model/later").rename("later/recording")
    assert few("recalibrate", "--model", "model", "later/recording")[0] == 0
    assert Path("later/recalibration.json").exists()
    assert Path("later/localizer.json").read_bytes() != before["localizer.json"]
    assert {path.name: path.read_bytes() for path in Path("model").iterdir() if path.is_file()} == before
