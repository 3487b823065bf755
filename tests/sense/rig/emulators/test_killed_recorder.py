"""A recording program that is killed in the middle of a press, on an emulated rig."""

import random
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

import padforge
from sense.recordings.press_journal import read_journal
from sense.recordings.recording import Recording
from sense.rig.arms.ur5.rtde_frames import RTDE_PORT
from tests.helpers.effort import few

pytest.importorskip("rtde_control")

SETTINGS = """[pad]
grid = 2
[rig]
rate_hz = 125.0
readings_per_press = 20
clearance_mm = 5
travel_mm_s = 500
press_mm_s = 250
acceleration_mm_s2 = 3000
"""
PROGRAM = """
import sys
from sense.rig.emulators import whole_rig
whole_rig.HOST = sys.argv.pop(1)
import padforge
padforge.main()
"""
ROUNDS = min(few(1).max_examples, 3)
PRESSES = 3 * ROUNDS + 1


def await_the_end_of_its_arm(address: str) -> None:
    """The emulated arm ends as soon as it finds that its program has."""
    end = time.monotonic() + 10
    while time.monotonic() < end:
        try:
            socket.create_connection((address, RTDE_PORT), 1.0).close()
        except ConnectionRefusedError:
            return
        except ConnectionResetError:  # it ends at this moment
            pass
        time.sleep(0.01)


@pytest.mark.usefixtures("own_address")
def test_a_killed_recorder_resumes_to_the_whole_plan(
    tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Killed while a press is under way: once a day, three times under stress."""
    monkeypatch.chdir(tmp_path)
    Path("pad.toml").write_text(SETTINGS, encoding="utf-8")
    words = f"sense record --through-drivers --presses {PRESSES} --out run --resume".split()
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[4]))
    journal = Path("run", "journal.ndjson")
    kept: set[int] = set()
    rng = random.Random(0)
    for _ in range(ROUNDS):
        process = subprocess.Popen([sys.executable, "-c", PROGRAM, address, *words], stderr=subprocess.DEVNULL)
        end = time.monotonic() + 60
        while not (journal.exists() and len(read_journal(journal)) >= len(kept) + 2):
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.wait()
        assert set(read_journal(journal)) >= kept
        kept = set(read_journal(journal))
        assert len(kept) >= 2
    await_the_end_of_its_arm(address)
    monkeypatch.setattr(sys, "argv", ["padforge", *words])
    with pytest.raises(SystemExit) as done:
        padforge.main()
    assert not done.value.code
    assert len(Recording.open(Path("run")).presses_mm) == PRESSES
    assert "nothing to resume" not in capsys.readouterr().err
