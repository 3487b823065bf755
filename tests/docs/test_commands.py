import re
import shlex
from collections.abc import Iterator
from inspect import cleandoc
from itertools import product
from pathlib import Path
from typing import Any

import click
import pytest

from padforge.cli import cli
from tests.docs.pages import BLOCK, PAGES, command_lines, relative


def commands(text: str) -> Iterator[tuple[str, bool]]:
    """Every `padforge ...` of a page: the lines of its shell blocks, and, where it need not be whole, of the text."""
    for block in BLOCK.finditer(text):
        if block["language"] in {"sh", "powershell"}:
            lines = command_lines(block["body"])
            yield from ((line, True) for line in lines if re.search(r"(^|[\s/])padforge ", f"{line} "))
    yield from ((found, False) for found in re.findall(r"`(padforge [^`]+)`", BLOCK.sub("", text)))


def arguments(command: str) -> Iterator[list[str]]:
    """The arguments of every call of padforge in a line of shell; `one|other` stands for two calls, [X] for none."""
    words = shlex.shlex(command, posix=True, punctuation_chars="&;>")
    words.whitespace_split = True
    calls: list[list[str]] = [[]]
    for word in words:
        if set(word) <= set("&;>|") or word == "2>":
            calls.append([])
        else:
            calls[-1].append(word)
    for call in calls:
        if call and call[0].rpartition("/")[2] == "padforge":
            choices = [word.split("|") for word in call[1:] if not re.fullmatch(r"\[.*\](\.\.\.)?", word)]
            yield from map(list, product(*choices))


def every(command: click.Command, name: str = "padforge") -> Iterator[tuple[str, click.Command]]:
    yield name, command
    for word, each in command.commands.items() if isinstance(command, click.Group) else ():
        yield from every(each, f"{name} {word}")


@pytest.fixture
def parser(monkeypatch: pytest.MonkeyPatch) -> click.Command:
    """The command line, of which only the parser is left: no command does anything, no file has to exist."""
    for _, command in every(cli):
        monkeypatch.setattr(command, "callback", lambda *_, **__: None)

    def convert(_: click.Path, value: Any, *__: Any) -> Path:
        return Path(value)

    monkeypatch.setattr(click.Path, "convert", convert)
    return cli


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_commands_on_pages_parse_and_quote_commas(page: Path, parser: click.Command) -> None:
    """PowerShell takes an argument with a comma apart, unless it is in quotes."""
    for command, whole in commands(page.read_text(encoding="utf-8")):
        assert not whole or "," not in re.sub(r"'[^']*'|\"[^\"]*\"", "", command), f"{relative(page)}: {command}"
        for call in arguments(command):
            try:
                parser.main(call, standalone_mode=False, prog_name="padforge")
            except click.ClickException as error:
                if not whole and isinstance(error, click.MissingParameter | click.exceptions.NoArgsIsHelpError):
                    continue
                pytest.fail(f"{relative(page)}: {command}: {error.format_message()}")


@pytest.mark.parametrize(
    ("name", "command"), list(every(cli)), ids=lambda value: value if isinstance(value, str) else ""
)
def test_help_examples_parse_and_groups_list_all_commands_uncut(name, command, parser) -> None:
    examples = [line for line in cleandoc(command.help or "").splitlines() if line.startswith("padforge ")]
    assert [line for line in examples if line.startswith(name)]
    for line in examples:
        example, _, _ = line.partition("  ")  # what follows explains it
        for call in arguments(example):
            parser.main(call, standalone_mode=False, prog_name="padforge")
    if isinstance(command, click.Group):
        for width in (60, 80):
            lines = [*command.get_help(click.Context(command, info_name=name, terminal_width=width)).splitlines(), ""]
            assert width < 80 or max(map(len, lines)) <= 80
            for word in command.commands:
                (listed,) = (line for line in lines if re.match(rf"  {word}  ", line))
                assert not lines[lines.index(listed) + 1].startswith("   "), "it goes on in the next line"
                assert width < 80 or not listed.endswith("..."), listed
