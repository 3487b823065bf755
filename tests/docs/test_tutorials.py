"""Tutorials do as they say.

A comment `<!-- run -->` before a block of shell commands says that it is run here, after all such blocks above it and
those of the tutorials before it. What it prints must be what the page shows below: text and whole numbers exactly,
decimals too, or within the share that a comment like `<!-- run: decimals within 20 % -->` grants where they hang on the
machine; the chances that it calls 1e8 may then differ as well. Seconds always may. With REWRITE_DOCS set in the
environment the pages are rewritten by what is printed, to be looked at before they are kept.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.docs.pages import BLOCK, ROOT, relative

TUTORIALS = [ROOT / "docs" / f"tutorial-{stage}.md" for stage in ("design", "fabricate", "sense", "study")]
REWRITE = "REWRITE_DOCS" in os.environ
SECONDS = re.compile(r"(?<![\w.])\d+(\.\d+)? s\b")
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")
OUTPUT = re.compile(r"\s*```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Run(NamedTuple):
    """A block that is run: its commands, what the page shows below and where, and by what share decimals may differ."""

    commands: str
    shown: str
    begin: int
    share: float


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
