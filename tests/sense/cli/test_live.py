import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import padforge
from design import Morphology
from sense import Localizer, Recording
from sense.cli.live import view_lines
from sense.live.page_server import LivePage
from sense.live.streams import messages
from sense.recordings.simulation.published_protocol import simulate
from sense.rig.devices.protocols import ConverterSamples, RigFault
from sense.rig.emulators import live_pad
from sense.rig.emulators.live_pad import SimulatedConverter
from sense.settings import RigSettings


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], model: Path) -> Callable[..., tuple]:
    """Run `padforge sense live`; gives exit code, stdout and stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(
            sys, "argv", ["padforge", "sense", "live", "--port", "0", "--model", str(model), *arguments]
        )
        with pytest.raises(SystemExit) as caught:
            padforge.main()
        out, err = capsys.readouterr()
        return caught.value.code or 0, out, err  # type: ignore[return-value]

    return run


def test_a_recording_is_shown(live, brief: Recording, tmp_path: Path) -> None:
    brief.save(tmp_path / "short", {})
    replay = ("--replay", str(tmp_path / "short"), "--speed", "1e6")
    code, out, err = live(*replay, "--json")
    assert code == 0
    assert "http://127.0.0.1:" in err
    told = [json.loads(line) for line in out.splitlines()]
    assert {each["event"] for each in told} == {"estimate"}
    assert not [key for key in told[0] if key.startswith(("depth", "force"))]
    assert [each["press"] for each in told] == list(range(len(told)))
    assert 38 <= len(told) <= 40
    code, plain, _ = live(*replay)
    assert code == 0
    first = told[0]
    assert plain.splitlines()[0].startswith(f"press 0: {first['x_mm']:.1f}, {first['y_mm']:.1f} mm, within ")
    assert len(plain.splitlines()) == len(told)


def test_other_programs_are_told_what_they_ask_for(live, brief: Recording, tmp_path: Path) -> None:
    brief.save(tmp_path / "short", {})
    replay = ("--replay", str(tmp_path / "short"), "--speed", "1e6")
    token = "a word of sixteen"
    code, _, err = live(*replay, "--tcp", "0", "--osc", "127.0.0.1:9", "--host", "127.0.0.1", "--token", token)
    assert code == 0
    assert re.search(r"^page: http://127\.0\.0\.1:\d+/\?token=a\+word\+of\+sixteen ", err, re.MULTILINE)
    assert re.search(r"^lines: 127\.0\.0\.1:\d+$", err, re.MULTILINE)
    for wrong, message in (
        (("--host", "0.0.0.0"), "host is '0.0.0.0', which other machines reach"),
        (("--osc", "here"), "--osc is 'here', expected HOST:PORT"),
        (("--tcp", "0", "--token", "short"), "token has 5 characters, allowed are 16 to 256"),
    ):
        code, out, err = live(*replay, *wrong)
        assert (code, out) == (2, "")
        assert message in err.splitlines()[-1]


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_replay_shows_the_pad_as_it_lay(
    live, brief: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mirrored: bool
) -> None:
    replace(brief, source={"rig": {"mirrored": mirrored}}).save(tmp_path / "short", {})
    seen: list[dict] = []
    monkeypatch.setattr(LivePage, "show", lambda page, view: seen.append(view))
    assert live("--replay", str(tmp_path / "short"), "--speed", "1e6")[0] == 0
    assert {view["mirrored"] for view in seen} == {mirrored}


def test_a_rig_shows_the_pad_as_it_lay_when_the_model_was_learnt(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A holder had said that it lies with its tracks up, so that `[rig]` leaves it open."""

    class Ended(SimulatedConverter):
        def read(self) -> ConverterSamples:
            raise KeyboardInterrupt

    shutil.copytree(model, tmp_path / "model")
    path = tmp_path / "model/recording/start.json"
    start = json.loads(path.read_text())
    start["source"]["rig"]["mirrored"] = True
    path.write_text(json.dumps(start))
    seen: list[dict] = []
    told: list[bool] = []
    monkeypatch.setattr(live_pad, "SimulatedConverter", Ended)
    monkeypatch.setattr(LivePage, "show", lambda page, view: seen.append(view))
    monkeypatch.setattr(messages, "Messages", lambda pipeline, mirrored: told.append(mirrored))
    arguments = ["padforge", "sense", "live", "--port", "0", "--model", str(tmp_path / "model")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit):
        padforge.main()
    assert {view["mirrored"] for view in seen} == set(told) == {True}


def test_mistakes_and_faults_are_one_line(live, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sense.rig.boards.due.serial_link

    monkeypatch.setattr(sense.rig.boards.due.serial_link, "find_ports", list)
    other = simulate(Morphology.straight(3), RigSettings(presses=3))
    other.save(tmp_path / "other", {})
    wired = tmp_path / "wired.toml"
    wired.write_text("[rig]\nchannels = [3, 0]\n")
    with LivePage(0) as page:
        port = page.url.rstrip("/").rsplit(":", 1)[1]
        for arguments, message in (
            (("--port", port), f"port {port} of 127.0.0.1: another program uses it"),
            (("--model", str(tmp_path)), "localizer.json: cannot be read"),
            (("--replay", str(tmp_path / "absent")), "no recording"),
            (("--replay", str(tmp_path / "other")), "readings are of 6 fibres, the localizer was learnt from 4"),
            (("--rig", "ur5"), "no board is found"),
            (("--rig", "ur5", "--spec", str(wired)), "[rig] channels: got 2 inputs, the pad has 4 fibres"),
            (("--speed", "0"), "--speed"),
        ):
            code, out, err = live(*arguments)
            assert (code, out) == (2, "")
            assert message in err.splitlines()[-1]


def test_the_end_comes_when_it_is_asked_for(live, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []

    class Interrupted(SimulatedConverter):
        def read(self) -> ConverterSamples:
            raise KeyboardInterrupt

        def close(self) -> None:
            closed.append(True)

    monkeypatch.setattr(live_pad, "SimulatedConverter", Interrupted)
    code, _, err = live()
    assert code == 130
    assert "interrupted" in err.splitlines()[-1]
    assert closed == [True]


def test_a_fault_of_the_rig_ends_it(live, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stale(SimulatedConverter):
        def read(self) -> ConverterSamples:
            raise RigFault("stale", "the board does not send", "reset it")

    monkeypatch.setattr(live_pad, "SimulatedConverter", Stale)
    code, out, err = live("--json")
    assert (code, out) == (1, "")
    assert err.splitlines()[-1] == "padforge: the board does not send; reset it"


def test_a_terminal_shows_fibres_by_their_numbers() -> None:
    """From 1, as the page does, and faults are told."""
    fibres = [{"swing": swing, "state": state} for swing, state in ((0.5, "sound"), (None, "dead"))]
    lines = view_lines({"pressed": False, "presses": [], "fibres": fibres, "findings": ["fibre 2 was dead"]})
    assert lines[:2] == ["waiting for a press", "no press yet"]
    assert [line.split()[:2] for line in lines[2:4]] == [["fibre", "1"], ["fibre", "2"]]
    assert lines[4] == "fibre 2 was dead"


def test_depth_and_force_are_told_where_they_were_learnt(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    deep_localizer: Localizer,
    deep_recording: Recording,
    tmp_path: Path,
) -> None:
    deep_localizer.save(tmp_path)
    deep_recording.save(tmp_path / "recording", {})
    replay = ["--replay", str(tmp_path / "recording"), "--speed", "1e6", "--port", "0", "--model", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["padforge", "sense", "live", *replay, "--json"])
    with pytest.raises(SystemExit):
        padforge.main()
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    deep = [each["depth_mm"] for each in told]
    assert 0 < min(deep) < 2 < 4 < max(deep) < 6
    assert all(each["force_r90_n"] > 0 and each["depth_r90_mm"] > 0 for each in told)
    monkeypatch.setattr(sys, "argv", ["padforge", "sense", "live", *replay])
    with pytest.raises(SystemExit):
        padforge.main()
    first = capsys.readouterr().out.splitlines()[0]
    assert f"{deep[0]:.1f} ± {told[0]['depth_r90_mm']:.1f} mm deep, {told[0]['force_n']:.1f} ± " in first
