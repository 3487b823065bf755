from pathlib import Path

import numpy as np

from padforge.common.files import sha256
from padforge.design import Morphology, RulesSettings, check_rules
from padforge.sense import Recording
from tests.helpers.door import called, refused


def test_example_is_a_buildable_pad_and_its_presses_again_at_every_call_and_spares_other_files(tmp_path: Path) -> None:
    (tmp_path / "pad.toml").write_text("[rig]\npresses = 3\n")  # which changes nothing
    first = called("example", cwd=tmp_path)
    assert first.code == 0, first
    assert "1500 presses over 44.96 x 44.97 mm, 60000 readings of 6 fibres" in first.out
    assert "padforge sense calibrate para5_long.mat" in first.out
    example = tmp_path / "out" / "example"
    pad, recording = Morphology.load(example / "morphology.json"), Recording.open(example / "recording")
    assert check_rules(pad, RulesSettings()) == []
    assert recording.source["kind"] == "simulated"
    assert (len(pad.knots), recording.readings.shape) == (6, (60_000, 6))
    np.testing.assert_allclose(np.abs(recording.presses_mm).max(axis=0), 22.5, atol=0.2)
    digest = sha256(example / "recording")
    assert called("example", cwd=tmp_path) == first
    assert sha256(example / "recording") == digest
    (tmp_path / "pad").mkdir()
    Morphology.straight(2).save(tmp_path / "pad/morphology.json")
    assert "pad: exists and is not empty" in refused("example", "--out", "pad", cwd=tmp_path)
