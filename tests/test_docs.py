"""The documentation: its commands parse, its tutorials do what they say, its links lead somewhere.

In a tutorial a comment `<!-- run -->` before a block of shell commands says that it is run here, after all such blocks
above it and those of the tutorials before it. What it prints must be what the page shows below: text and whole numbers
exactly, decimals too, or within the share that a comment like `<!-- run: decimals within 20 % -->` grants where they
hang on the machine; the chances that it calls 1e8 may then differ as well. Seconds always may. With REWRITE_DOCS set in
the environment the pages are rewritten by what is printed, to be looked at before they are kept.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from inspect import cleandoc
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import click
import pytest

from padforge import cli

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = [ROOT / "docs" / f"tutorial-{stage}.md" for stage in ("design", "fabricate", "sense", "study")]
REWRITE = "REWRITE_DOCS" in os.environ
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]

SECONDS = re.compile(r"(?<![\w.])\d+(\.\d+)? s\b")
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")
BLOCK = re.compile(
    r"(?:^<!-- run(?P<how>: [^\n]*)? -->\n+)?^```(?P<language>\w*)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL
)
OUTPUT = re.compile(r"\s*```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


class Run(NamedTuple):
    """A block that is run: its commands, what the page shows below and where, and by what share decimals may differ."""

    commands: str
    shown: str
    begin: int
    share: float


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def runs(text: str) -> Iterator[Run]:
    """The blocks of a page that are run, in order."""
    for block in BLOCK.finditer(text):
        if not block[0].startswith("<!-- run"):
            continue
        how = block["how"] or ""
        output = OUTPUT.match(text, block.end())
        share = re.search(r"decimals within (\d+) %", how)
        shown, begin = (output[1], output.start(1)) if output else ("", -1)
        yield Run(block["body"], shown, begin, int(share[1]) / 100 if share else 0.0)


def difference(shown: str, printed: str, share: float) -> str:
    """Where what is printed differs from what a page shows; empty if it does not."""
    pages, prints = (SECONDS.sub("# s", text).strip().splitlines() for text in (shown, printed))
    if len(pages) != len(prints):
        return f"{len(prints)} lines, the page has {len(pages)}"
    for page, line in zip(pages, prints, strict=True):
        if not (page.rstrip() == line.rstrip() or (share and alike(page, line, share))):
            return f"{line!r}, the page has {page!r}"
    return ""


def alike(page: str, line: str, share: float) -> bool:
    """Whether two lines differ by their decimals alone, and these by no more than a share of them."""
    if NUMBER.sub("#", page).split() != NUMBER.sub("#", line).split():
        return False
    for one, other in zip(NUMBER.findall(page), NUMBER.findall(line), strict=True):
        chances = one.startswith("1e") and other.startswith("1e")
        decimals = "." in one or "." in other
        if one != other and not chances and not (decimals and abs(float(other) - float(one)) <= slack(one, share)):
            return False
    return True


def slack(number: str, share: float) -> float:
    """A share of a number, but no less than one of its last digits."""
    digits = len(number.partition(".")[2].partition("e")[0])
    return max(share * abs(float(number)), 1.001 * 10.0**-digits)


def commands(text: str) -> Iterator[tuple[str, bool]]:
    """Every `padforge ...` of a page: the lines of its shell blocks, and, where it need not be whole, of the text."""
    for block in BLOCK.finditer(text):
        if block["language"] == "sh":
            lines = block["body"].replace("\\\n", " ").splitlines()
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
def test_every_command_parses(page: Path, parser: click.Command) -> None:
    for command, whole in commands(page.read_text(encoding="utf-8")):
        for call in arguments(command):
            try:
                parser.main(call, standalone_mode=False, prog_name="padforge")
            except click.ClickException as error:
                if not whole and isinstance(error, click.MissingParameter | click.exceptions.NoArgsIsHelpError):
                    continue
                pytest.fail(f"{relative(page)}: {command}: {error.format_message()}")


@pytest.mark.parametrize(("name", "command"), every(cli), ids=lambda value: value if isinstance(value, str) else "")
def test_help_has_examples_that_parse(name: str, command: click.Command, parser: click.Command) -> None:
    lines = [line for line in cleandoc(command.help or "").splitlines() if line.startswith("padforge ")]
    assert [line for line in lines if line.startswith(name)]
    for line in lines:
        example, _, _ = line.partition("  ")  # what follows explains it
        for call in arguments(example):
            parser.main(call, standalone_mode=False, prog_name="padforge")


def test_the_parser_refuses_what_does_not_exist(parser: click.Command) -> None:
    for wrong in ("padforge desing", "padforge design --no-such", "padforge sense locate x", "padforge init a b"):
        with pytest.raises(click.ClickException):
            parser.main(next(arguments(wrong)), standalone_mode=False)


@pytest.mark.skipif(not all(map(shutil.which, ("sh", "awk", "sed"))), reason="needs the tools of a Unix shell")
def test_the_tutorials_do_as_they_say(tmp_path: Path) -> None:
    program = tmp_path / "bin" / "padforge"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m padforge "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    folder = tmp_path / "work"
    folder.mkdir()
    path = os.pathsep.join((str(program.parent), os.environ["PATH"]))
    for page in TUTORIALS:
        text = page.read_text(encoding="utf-8")
        blocks = list(runs(text))
        assert blocks, f"{relative(page)}: no block is run"
        moved = 0
        for block in blocks:
            printed = run(block.commands, folder, path)
            wrong = difference(block.shown, printed, block.share)
            assert REWRITE or not wrong, f"{relative(page)}: {block.commands}printed {wrong}"
            if wrong and block.begin >= 0:
                begin, end = block.begin + moved, block.begin + moved + len(block.shown)
                text = text[:begin] + printed.rstrip() + "\n" + text[end:]
                moved += len(printed.rstrip()) + 1 - len(block.shown)
        if REWRITE:
            page.write_text(text, encoding="utf-8")


def run(commands: str, folder: Path, path: str) -> str:
    """What shell commands print, errors included; they must succeed."""
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "", "COLUMNS": "80"}
    result = subprocess.run(
        ["sh", "-c", commands],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, f"{commands}{result.stdout}"
    return result.stdout


@pytest.mark.parametrize(
    ("shown", "printed", "share", "same"),
    [
        ("8 fibres in 36.2 s", "8 fibres in 5 s", 0.0, True),
        ("8 fibres in 36.2 s", "7 fibres in 5 s", 0.5, False),
        ("mean 1.20", "mean 1.30", 0.1, True),
        ("mean 1.20", "mean 1.30", 0.0, False),
        ("mean  1.20", "mean 11.30", 0.1, False),
        ("0.01 off", "0.02 off", 0.1, True),
        ("8 mm, 1e8", "8.1 mm, 1e9", 0.1, True),
        ("press 300", "press 301", 0.9, False),
        ("a 1.0", "b 1.0", 0.9, False),
        ("one", "one\ntwo", 0.9, False),
    ],
)
def test_outputs_are_compared_number_by_number(shown: str, printed: str, share: float, same: bool) -> None:
    assert (difference(shown, printed, share) == "") is same


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(BLOCK.sub("", page.read_text(encoding="utf-8"))):
        if "://" in target or target.startswith("mailto:"):
            continue
        name, _, anchor = target.partition("#")
        there = page.parent / name if name else page
        assert there.exists(), f"{relative(page)}: {target}"
        if anchor:
            assert anchor in anchors(there.read_text(encoding="utf-8")), f"{relative(page)}: {target}"


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_no_page_knows_the_machine_it_was_written_on(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert str(ROOT) not in text
    assert not re.search(r"(?<![\w.:/])/(work|home|tmp|opt|root|Users|mnt)/", text)
    assert not re.search(r"\b[A-Z]:\\", text)
