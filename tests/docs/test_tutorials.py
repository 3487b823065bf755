"""Tutorials and how-to pages print what they show.

A block of shell commands after a comment `<!-- run -->` is run here, after all such blocks above it and those of the
page that it continues. What it prints must be what the page shows below: text and whole numbers exactly, decimals
exactly or within the share of a comment like `<!-- run: decimals within 20 % -->`; probabilities such as 1e8 may then
differ as well. Times always may. After `<!-- run: numbers vary -->` it prints the same kinds of lines, whatever their
numbers and how many there are: a search on another processor rounds differently, and ends in another pad. With
REWRITE_DOCS set in the environment the pages are rewritten by what is printed.
"""

import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest.mock import patch

import pytest

from padforge.sense.health import trace_model
from tests.docs.pages import BLOCK, ROOT, relative
from tests.helpers.door import call
from tests.helpers.once import Once

BASES = {
    "tutorial-design": None,
    "tutorial-fabricate": "tutorial-design",
    "tutorial-sense": "tutorial-design",
    "tutorial-study": "tutorial-design",
    "tutorial-press": None,
    "tutorial-twin": "tutorial-sense",
    "example": None,
    "howto-ros": "example",
    "howto-lerobot": "example",
    "howto-microcontroller": "example",
}
"""Pages that are run, and the page that each continues."""
REWRITE = "REWRITE_DOCS" in os.environ
SHORTER = 1 if REWRITE else 10
"""What finds faults learns for this share of its time, which no page shows."""
SECONDS = re.compile(r"(?<![\w.])\d+(\.\d+)? s\b")
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")
PROGRAM = """#!/bin/sh
counter={0}
printf '%s\\n' "$PWD" "$@" > "$counter/asking" && mv "$counter/asking" "$counter/asked"
until [ -e "$counter/code" ]; do sleep 0.05; done
cat "$counter/err" >&2
cat "$counter/out"
read -r code < "$counter/code"
rm "$counter/code"
exit "$code"
"""
"""What the shell finds as `padforge`: it asks this process, which has all libraries loaded, and says what it says."""
OUTPUT = re.compile(r"\s*```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Run(NamedTuple):
    """A block that is run: its commands, what the page shows below and where, and how that may differ."""

    commands: str
    shown: str
    begin: int
    share: float  # by which decimals may differ
    varies: bool  # whether all numbers may


def runs(text: str) -> Iterator[Run]:
    """The blocks of a page that are run, in order."""
    for block in BLOCK.finditer(text):
        if not block[0].startswith("<!-- run"):
            continue
        how = block["how"] or ""
        output = OUTPUT.match(text, block.end())
        share = re.search(r"decimals within (\d+) %", how)
        shown, begin = (output[1], output.start(1)) if output else ("", -1)
        yield Run(block["body"], shown, begin, int(share[1]) / 100 if share else 0.0, "numbers vary" in how)


def difference(block: Run, printed: str) -> str:
    """Where what is printed differs from what a page shows; empty if it does not."""
    pages, prints = (SECONDS.sub("# s", text).strip().splitlines() for text in (block.shown, printed))
    if block.varies:
        odd = ({kind(line) for line in pages} ^ {kind(line) for line in prints}) - VERDICTS
        return f"{sorted(odd)} are lines of the page or printed, not both" if odd else ""
    if len(pages) != len(prints):
        return f"{len(prints)} lines, the page has {len(pages)}"
    for page, line in zip(pages, prints, strict=True):
        if not (page.rstrip() == line.rstrip() or (block.share and alike(page, line, block.share))):
            return f"{line!r}, the page has {page!r}"
    return ""


VERDICTS = {
    "not significantly better than straight fibres with # failed fibres",
    "straight fibres explain #, about as much as this plan does: is it the recording of this pad?",
}
"""Lines that follow a search, and an identification, only where the pad is that little better."""


def masked(line: str) -> str:
    """A line without its numbers, and with single spaces."""
    return " ".join(NUMBER.sub("#", line).split())


def kind(line: str) -> str:
    """A line without its numbers and lists of numbers."""
    return re.sub(r"#(?:(?:,| /) #)*", "#", masked(line))


DETECTED = re.compile(r"(?<=detected at press )\d+")
"""The press at which a fault is known, which is the first or the second one by the pad that a search finds."""


def alike(page: str, line: str, share: float) -> bool:
    """Whether two lines differ by their decimals alone, and these by no more than a share of them."""
    page, line = (DETECTED.sub("N", each) for each in (page, line))
    if masked(page) != masked(line):
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


def followed(page: str, once: Once) -> tuple[Path, str]:
    """Return the folder in which a page was followed, and where the page was wrong."""

    def make(folder: Path) -> tuple[Path, str]:
        if base := BASES[page]:
            shutil.copytree(followed(base, once)[0], folder, dirs_exist_ok=True)
        return folder, follow(ROOT / "docs" / f"{page}.md", folder)

    return once(page, make)


needs_unix_shell = pytest.mark.skipif(
    not all(map(shutil.which, ("sh", "awk", "sed"))), reason="needs the tools of a Unix shell"
)


@pytest.mark.slow
@needs_unix_shell
@pytest.mark.parametrize("page", BASES)
def test_pages_print_what_they_show(page: str, once: Once) -> None:
    _, wrong = followed(page, once)
    assert REWRITE or not wrong, wrong


def follow(page: Path, folder: Path) -> str:
    """Run the blocks of a page; where the first is not as the page says, empty if all are."""
    text = page.read_text(encoding="utf-8")
    blocks = list(runs(text))
    assert blocks, f"{relative(page)}: no block is run"
    moved = 0
    for block in blocks:
        printed = run(block.commands, folder)
        wrong = difference(block, printed)
        if wrong and not REWRITE:
            return f"{relative(page)}: {block.commands}printed {wrong}"
        if wrong and block.begin >= 0:
            begin, end = block.begin + moved, block.begin + moved + len(block.shown)
            text = text[:begin] + printed.rstrip() + "\n" + text[end:]
            moved += len(printed.rstrip()) + 1 - len(block.shown)
    if REWRITE:
        page.write_text(text, encoding="utf-8")
    return ""


def run(commands: str, folder: Path) -> str:
    """What shell commands print, errors included; they must succeed."""
    with TemporaryDirectory() as name, (Path(name) / "printed").open("w+", encoding="utf-8") as printed:
        (program := Path(name) / "padforge").write_text(PROGRAM.format(name), encoding="utf-8")
        program.chmod(0o755)
        environment = os.environ | {"PATH": os.pathsep.join((name, os.environ["PATH"])), "COLUMNS": "80"}
        with patch.dict(os.environ, environment):
            shell = subprocess.Popen(["sh", "-c", commands], cwd=folder, stdout=printed, stderr=subprocess.STDOUT)
            try:
                while shell.poll() is None:
                    answer(Path(name))
                    time.sleep(0.01)
            finally:
                shell.kill()
                shell.wait()
        text = Path(printed.name).read_text(encoding="utf-8")
    assert shell.returncode == 0, f"{commands}{text}"
    return text


def answer(counter: Path) -> None:
    """Run what the program in the shell was asked for, if anything, in this process."""
    if not (counter / "asked").exists():
        return
    here, *words = (counter / "asked").read_text(encoding="utf-8").splitlines()
    (counter / "asked").unlink()
    with chdir(here), patch.object(trace_model, "MAX_STEPS", trace_model.MAX_STEPS // SHORTER):
        ended = call(*words)
    (counter / "err").write_text(ended.err, encoding="utf-8")
    (counter / "out").write_text(ended.out, encoding="utf-8")
    (counter / "ending").write_text(f"{ended.code}\n", encoding="utf-8")
    (counter / "ending").rename(counter / "code")
