"""Tutorials and how-to pages print what they show.

A page is followed from its first block to its last, in the folder that the page has left which it continues:

- A block with a title is written to the file of that name.
- A block of commands after a comment `<!-- run -->` is run. Each line is a `padforge ...` or a `python FILE`, since all
  shells run these alike. What they print must be what the block of text below shows. `<!-- run: exit code 1 -->` is the
  code of the last command; all others end with 0.
- A block of text after `<!-- file: FILE -->` shows lines of that file, or the files of a folder.

Text and whole numbers must be as shown, decimals exactly or within the share of a comment like `<!-- run: decimals
within 20 % -->`; probabilities such as 1e8 may then differ as well. Times always may. After `<!-- run: numbers vary
-->` the same kinds of lines are printed, whatever their numbers and how many there are: a search on another processor
rounds differently, and ends in another pad. A line `...` stands for any lines. With REWRITE_DOCS set in the environment
the pages are rewritten by what is printed.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import pytest

from padforge.design.objectives import bayes_error
from padforge.design.optimize import problem
from padforge.sense.health import trace_model
from tests.docs.pages import BLOCK, ROOT, command_lines, relative
from tests.helpers.door import Ended, called
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
    "howto-deploy": "example",
}
"""Pages that are run, and the page that each continues."""
REWRITE = "REWRITE_DOCS" in os.environ
SHORTER = 1 if REWRITE else 10
"""What finds faults learns for this share of its time, which no page shows; so do searches whose numbers may vary."""
SECONDS = re.compile(r"(?<![\w.])\d+(\.\d+)? s\b")
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")
OUTPUT = re.compile(r"\s*```text\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Shown(NamedTuple):
    """Lines that a page shows: where, and how what is printed may differ from them."""

    text: str = ""
    begin: int = -1  # in the text of the page; -1 if it shows nothing
    how: str = ""
    is_part: bool = False  # of a file, which may have more

    @property
    def lines(self) -> list[str]:
        lines = self.text.strip().splitlines()
        return ["...", *lines, "..."] if self.is_part else lines

    @property
    def varies(self) -> bool:
        return "numbers vary" in self.how

    def has(self, line: str, other: str) -> bool:
        """Whether a line and a printed one are equal or of one kind, or alike within a share of their decimals."""
        if self.varies:
            return same_kind(line, other)
        share = re.search(r"decimals within (\d+) %", self.how)
        return line.rstrip() == other.rstrip() or bool(share and alike(line, other, int(share[1]) / 100))


def difference(page: Shown, printed: str) -> str:
    """Where what is printed differs from what a page shows; empty if it does not."""
    shows = [SECONDS.sub("# s", line) for line in page.lines]
    prints = [SECONDS.sub("# s", line) for line in printed.strip().splitlines()]
    if "..." in shows:
        return "" if find_lines(shows, prints, page.has) else f"no lines like those of the page:\n{printed}"
    if page.varies:
        odd = ({kind(line) for line in shows} ^ {kind(line) for line in prints}) - VERDICTS
        return f"{sorted(odd)} are lines of the page or printed, not both" if odd else ""
    if len(shows) != len(prints):
        return f"{len(prints)} lines, the page has {len(shows)}"
    differ = ((line, other) for line, other in zip(shows, prints, strict=True) if not page.has(line, other))
    return next((f"{other!r}, the page has {line!r}" for line, other in differ), "")


def find_lines(shows: list[str], prints: list[str], is_same: Callable[[str, str], bool]) -> list[str] | None:
    """Return what is printed where a page shows lines, with its `...` for the rest; None if it is not there."""
    if not shows or shows == ["..."]:
        return shows if shows or not prints else None
    if shows[0] == "...":
        ends = (find_lines(shows[1:], prints[skipped:], is_same) for skipped in range(len(prints)))
        return next((["...", *end] for end in ends if end is not None), None)
    if not (prints and is_same(shows[0], prints[0])):
        return None
    end = find_lines(shows[1:], prints[1:], is_same)
    return None if end is None else [prints[0], *end]


def same_kind(page: str, line: str) -> bool:
    return kind(page) == kind(line)


VERDICTS = {
    "not significantly better than straight fibres with # failed fibres",
    "straight fibres explain #, about as much as this plan does: is it the recording of this pad?",
}
"""Lines that follow a search, and an identification, only where the pad is that little better."""


def masked(line: str) -> str:
    return " ".join(NUMBER.sub("#", line).split())


def kind(line: str) -> str:
    return re.sub(r"#(?:(?:,| /) #)*", "#", masked(line))


OF_THE_PAD = re.compile(r"(?<=detected at press )\d+|\d+(?= crossings)|(?<=of the old model: fibres )\d+(, \d+)*")
"""Whole numbers that depend on the pad that a search finds: the press at which a fault is known, crossings, fibres that
are learnt again."""


def alike(page: str, line: str, share: float) -> bool:
    """Whether two lines differ by their decimals alone, and these by a share of them or one of the last digits."""
    page, line = (OF_THE_PAD.sub("N", each) for each in (page, line))
    if masked(page) != masked(line):
        return False
    for one, other in zip(NUMBER.findall(page), NUMBER.findall(line), strict=True):
        chances = one.startswith("1e") and other.startswith("1e")
        last_digit = 1.001 * 10.0 ** -len(one.partition(".")[2].partition("e")[0])
        is_near = abs(float(other) - float(one)) <= max(share * abs(float(one)), last_digit)
        if one != other and not chances and not (is_near and "." in one + other):
            return False
    return True


def followed(page: str, once: Once) -> tuple[Path, str]:
    """Return the folder in which a page was followed, and where the page was wrong."""

    def make(folder: Path) -> tuple[Path, str]:
        if base := BASES[page]:
            shutil.copytree(followed(base, once)[0], folder, dirs_exist_ok=True)
        return folder, follow(ROOT / "docs" / f"{page}.md", folder)

    return once(page, make)


@pytest.mark.slow
@pytest.mark.parametrize("page", BASES)
def test_pages_print_what_they_show(page: str, once: Once) -> None:
    _, wrong = followed(page, once)
    assert REWRITE or not wrong, wrong


def follow(page: Path, folder: Path) -> str:
    """Do what the blocks of a page say; where the first is not as the page shows, empty if all are."""
    text = page.read_text(encoding="utf-8")
    blocks = [block for block in BLOCK.finditer(text) if block["kind"] or block["title"]]
    assert any(block["kind"] == "run" for block in blocks), f"{relative(page)}: no block is run"
    wrong: list[tuple[Shown, str]] = []
    for block in blocks:
        if block["title"]:
            (folder / block["title"]).write_text(block["body"], encoding="utf-8")
            continue
        how = block["how"] or ""
        if block["kind"] == "file":
            lines = Shown(block["body"], block.start("body"), how, is_part=True)
            printed = contents(folder, how.partition(",")[0])
        else:
            output = OUTPUT.match(text, block.end())
            lines = Shown(output[1], output.start(1), how) if output else Shown(how=how)
            code = re.search(r"exit code (\d+)", how)
            printed = run(block["body"], folder, int(code[1]) if code else 0)
        if differs := difference(lines, printed):
            if not REWRITE:
                return f"{relative(page)}: {block[0]}\nprinted {differs}"
            wrong.append((lines, printed))
    for lines, printed in reversed(wrong):
        text = rewritten(text, lines, printed)
    if REWRITE:
        page.write_text(text, encoding="utf-8")
    return ""


def rewritten(text: str, page: Shown, printed: str) -> str:
    """Return the text of a page with what is printed, where it shows something."""
    if page.begin < 0:
        return text
    prints = printed.rstrip().splitlines()
    if "..." in page.lines:
        prints = find_lines(page.lines, printed.strip().splitlines(), same_kind)
        assert prints, f"no lines of the kinds that the page shows:\n{page.text}\nin\n{printed}"
        prints = prints[1:-1] if page.is_part else prints
    return text[: page.begin] + "\n".join(prints) + "\n" + text[page.begin + len(page.text) :]


def contents(folder: Path, name: str) -> str:
    path = folder / name
    if path.is_dir():
        files = (each.relative_to(folder).as_posix() for each in path.rglob("*") if each.is_file())
        return "\n".join(sorted(files))
    return path.read_text(encoding="utf-8")


def run(commands: str, folder: Path, code: int) -> str:
    """What commands print, errors first; the last one ends with `code`, and those before with 0."""
    texts = []
    calls = [shlex.split(line) for line in command_lines(commands)]
    for index, (program, *words) in enumerate(calls):
        ended = {"padforge": run_padforge, "python": run_python}[program](words, folder)
        texts.append(ended.err + ended.out)
        assert ended.code == (code if index == len(calls) - 1 else 0), f"{commands}{ended}"
    return "".join(texts)


def run_padforge(words: list[str], folder: Path) -> Ended:
    share = SHORTER if "--twin" in words or words[:2] == ["design", "compare"] else 1
    with (
        patch.dict(os.environ, COLUMNS="80"),
        patch.object(trace_model, "MAX_STEPS", trace_model.MAX_STEPS // SHORTER),
        patch.dict(problem.STEPS, {contact: steps // share for contact, steps in problem.STEPS.items()}),
        patch.object(bayes_error, "PRESSES", bayes_error.PRESSES // share),
    ):
        return called(*words, cwd=folder)


def run_python(words: list[str], folder: Path) -> Ended:
    ended = subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True, check=False)
    return Ended(ended.returncode, ended.stdout, ended.stderr)
