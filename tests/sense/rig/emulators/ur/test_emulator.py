"""The emulated arm: the record of what it really did, its dashboard, and what it leaves behind."""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from sense.rig.arms.ur5 import rtde_frames as ur_frames
from sense.rig.devices.protocols import RigFault
from sense.rig.emulators.ur import truth as ur_truth
from sense.rig.emulators.ur.emulator import UrEmulator


def test_the_truth_keeps_the_newest_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur_truth, "ROWS", 64)
    ur_truth.create(tmp_path / "truth")
    writer, truth = ur_truth.TruthWriter(tmp_path / "truth"), ur_truth.Truth(tmp_path / "truth")
    with pytest.raises(ValueError, match="before the oldest"):
        truth.pose_at(0.0)
    for i in range(100):
        writer.append(i, np.full(6, 10.0 * i), 0.0)
    np.testing.assert_allclose(truth.pose_at([70.5, 99, 200])[:, 0], [705, 990, 990])
    with pytest.raises(ValueError, match="before the oldest"):
        truth.pose_at(36.0)


def test_one_at_a_time_and_the_ports_are_free_again(address: str) -> None:
    taken = re.escape(f"{address}: Address already in use")
    with UrEmulator(host=address), pytest.raises(RigFault, match=taken) as caught:
        UrEmulator(host=address).__enter__()
    assert "\n" not in str(caught.value)
    with UrEmulator("e", host=address) as robot:
        robot.remote_control(False)
        asked = ["PolyscopeVersion", "is in remote control", "get serial number", "running", "nonsense"]
        answers = ur_frames.ask_dashboard(address, asked, 1.0)
        assert answers[0].startswith("URSoftware 5.12.2.")
        assert answers[1:4] == ["false", "20185500000", "Program running: false"]
        assert answers[4].startswith("could not understand")
        assert robot.asked() == asked


LEFT = """
import os, sys
from sense.rig.emulators.ur.emulator import UrEmulator
with UrEmulator(host=sys.argv[1]):
    os._exit(9)
"""


@pytest.mark.slow
def test_what_a_killed_program_has_left_among_temporary_files_goes_with_the_next(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing else goes, nor the file of one that is at work."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    near = {
        "padforge-ur-mine",
        "padforge-ur-0123456789abcde",
        "padforge-ur-127.0.0.1.lock",
        "padforge-arm-127.0.0.1.lock",
    }
    for name in near:
        (tmp_path / name).touch()
    assert subprocess.run([sys.executable, "-c", LEFT, address], check=False).returncode == 9
    assert len(list(tmp_path.iterdir())) == len(near) + 1
    time.sleep(0.5)  # its arm finds that its program has ended
    with UrEmulator(host=address):
        at_work = {path.name for path in tmp_path.iterdir()} - near
        assert len(at_work) == 1
        with pytest.raises(RigFault, match="is there another one"), UrEmulator(host=address):
            pass
        assert {path.name for path in tmp_path.iterdir()} == near | at_work
    assert {path.name for path in tmp_path.iterdir()} == near
