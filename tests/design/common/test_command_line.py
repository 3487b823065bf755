"""The command line's terminal: log records on stderr, also beside a progress bar."""

import logging
import re

import click
import pytest

from padforge.design.common import command_line

_log = logging.getLogger("padforge.sense.somewhere")


@click.command()
@click.option("--bar", is_flag=True)
def log(bar: bool) -> None:
    if bar:
        with command_line.progress() as progress:
            progress.add_task("training", total=2, note="1 of 2")
            progress.refresh()
            _log.warning("a warning")
            progress.refresh()
    else:
        _log.info("a note of 100 %")
        _log.debug("for debugging")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["padforge", *arguments])
    return command_line.run_to_end(log, "padforge", {})


def test_command_line_prints_log_records_as_plain_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for _ in range(2):
        assert run(monkeypatch) == 0
        assert capsys.readouterr() == ("", "a note of 100 %\n")


def test_log_record_is_on_a_line_of_its_own_above_a_progress_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "80"}.items():
        monkeypatch.setenv(name, value)
    assert run(monkeypatch, "--bar") == 0
    lines = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", capsys.readouterr().err).replace("\r", "\n").split("\n")
    assert "a warning" in lines
    assert [line for line in lines if line.startswith("training")]
