import logging
import re
from pathlib import Path

import click
import pytest

from padforge.common import command_line
from padforge.common.validation import InputError
from padforge.design.cli import search_progress

_log = logging.getLogger("padforge.sense.somewhere")


@click.command()
@click.option("--bar", is_flag=True)
def log(bar: bool) -> None:
    if bar:
        with command_line.progress_bar("training") as training:
            training(1, 0, "begun")
            _log.warning("a warning")
            training(1, 2, "error 3 mm")
        with search_progress() as search:
            for done, start in ((20, 1), (10, 2), (40, 1)):
                search(done, 40, f"start {start}: objective 0.{done}, best 0.1")
    else:
        _log.info("a note of 100 %")
        _log.debug("for debugging")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["padforge", *arguments])
    return command_line.run_to_end(log, "padforge", {})


def test_log_records_are_plain_lines_and_above_a_progress_bar_lines_of_their_own(monkeypatch, capsys) -> None:
    for _ in range(2):
        assert run(monkeypatch) == 0
        assert capsys.readouterr() == ("", "a note of 100 %\n")
    for name, value in {"FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "80"}.items():
        monkeypatch.setenv(name, value)
    assert run(monkeypatch, "--bar") == 0
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", capsys.readouterr().err).replace("\r", "\n")
    bars = {line.rpartition(" ")[0].rstrip() for line in re.sub("[━╸╺]+", "-", shown).split("\n")}
    starts = (f"start {start}      - objective 0.{done}, best 0.1" for start, done in ((1, 40), (2, 10)))
    assert bars >= {"training     - 1 of 2  error 3 mm", *starts}, shown
    assert "\na warning\n" in shown


def test_text_table_aligns_text_to_the_left_and_numbers_to_the_right() -> None:
    rows = [["pad", "mm", "note"], ["a", "10.5", "x"], ["longer", "9"]]
    assert command_line.text_table(rows) == ["pad       mm  note", "a       10.5     x", "longer     9     -"]
    assert command_line.text_table(rows, (0, 2)) == ["pad       mm  note", "a       10.5  x   ", "longer     9  -   "]
    assert command_line.text_table([["1", "22"], ["333", "4"]], ()) == ["  1  22", "333   4"]


def test_results_without_out_go_beside_their_pad(tmp_path: Path) -> None:
    names = {"mine/morphology.json": "mine", "5.mat": "out/5", "data/twin.JSON": "data", "drawn.svg": "out/drawn"}
    assert {name: str(command_line.pad_folder(Path(name))) for name in names} == names
    assert command_line.pad_folder() == Path("out/pad")
    (tmp_path / "pad").mkdir()
    assert command_line.pad_folder(tmp_path / "pad") == tmp_path


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("got 3, allowed is 2"), 2, "got 3, allowed is 2"),
        (click.UsageError("no such option"), 2, "no such option"),
        (KeyboardInterrupt(), 130, "interrupted; what was finished is kept"),
        (KeyboardInterrupt("2 pads are there"), 130, "interrupted; 2 pads are there"),
        (FileNotFoundError(2, "No such file", "pad.json"), 2, "pad.json: No such file"),
        (OSError("full"), 2, "full"),
        (MemoryError(), 2, "out of memory"),
        (InputError("two\nlines \x1b[31m"), 2, r"two lines \x1b[31m"),
    ],
)
def test_errors_end_in_one_line(monkeypatch, capsys, error, code, line) -> None:
    @click.command()
    def fail() -> None:
        raise error

    monkeypatch.setattr("sys.argv", ["padforge"])
    assert command_line.run_to_end(fail, "padforge", {}) == code
    out, err = capsys.readouterr()
    assert (out, err.lstrip("\n")) == ("", f"padforge: {line}\n")  # click ends the line of a ^C


def test_texts_of_files_feign_no_lines(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor do they give orders to the terminal, on whichever way they reach it."""

    @click.command()
    def show() -> None:
        text = "µ\x1b[2K\nall fibres sound"
        command_line.echo(text)
        command_line.echo(text, err=True)
        command_line.show_result({}, [text, "next"], as_json=False)
        logging.getLogger("padforge").warning("%s", text)

    monkeypatch.setattr("sys.argv", ["padforge"])
    assert command_line.run_to_end(show, "padforge", {}) == 0
    line = r"µ\x1b[2K\nall fibres sound" + "\n"
    assert capsys.readouterr() == (f"{line}{line}next\n", line * 2)
