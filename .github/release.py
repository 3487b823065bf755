"""Releases, cut from the changelog.

`python .github/release.py cut VERSION` makes a section of VERSION and today of what is unreleased in `CHANGELOG.md`,
writes the version into `pyproject.toml` and `CITATION.cff`, and prints the release notes, which are that section.
`python .github/release.py notes VERSION` prints them again, if all three files agree that VERSION is what they release.
"""

import re
import subprocess
import sys
from datetime import date
from pathlib import Path

PLACEHOLDERS = ("OWNER", "MAINTAINER", "example.org")
"""Words of `pyproject.toml` and `CITATION.cff` that stand for what is not decided: nothing is released with them."""
CHANGELOG, PROJECT, CITATION = "CHANGELOG.md", "pyproject.toml", "CITATION.cff"
_VERSION_LINES = {
    PROJECT: re.compile(r'^version = "(?P<version>.*)"\n', re.MULTILINE),
    CITATION: re.compile(r"^version: (?P<version>.*)\n(?:date-released: .*\n)?", re.MULTILINE),
}
_HEADING = re.compile(r"^## (\S+).*\n", re.MULTILINE)


def changelog_sections(changelog: str) -> dict[str, str]:
    """Split a changelog into the texts below its headings, by version or `Unreleased`, in their order."""
    _, *parts = _HEADING.split(changelog)
    return {name: text.strip() for name, text in zip(parts[::2], parts[1::2], strict=True)}


def cut_changelog(changelog: str, version: str, day: date) -> str:
    """Make what is unreleased the section of a version.

    Args:
        changelog: text of `CHANGELOG.md`.
        version: `X.Y.Z`, above all versions that have a section.
        day: of the release.

    Raises:
        ValueError: another kind of version, one that is not above the last, or nothing is unreleased.
    """
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise ValueError(f"version: got {version}, allowed is X.Y.Z of numbers")
    sections = changelog_sections(changelog)
    released = [name for name in sections if name != "Unreleased"]
    if released and _numbers(version) <= _numbers(released[0]):
        raise ValueError(f"version: got {version}, allowed is one above {released[0]}, the last of {CHANGELOG}")
    if not re.search(r"^- ", sections.get("Unreleased", ""), re.MULTILINE):
        raise ValueError(f"{CHANGELOG}: lists nothing under Unreleased, so there is nothing to release")
    return changelog.replace("## Unreleased\n", f"## Unreleased\n\n## {version} - {day.isoformat()}\n", 1)


def cut(root: Path, version: str, day: date) -> str:
    """Write a version into the files of a checkout, and return its release notes.

    Raises:
        ValueError: the checkout has changes that are not committed, placeholders, or as `cut_changelog`.
    """
    status = subprocess.run(["git", "status", "--porcelain"], cwd=root, capture_output=True, text=True, check=True)
    if status.stdout:
        raise ValueError(
            f"the checkout has changes that are not committed, such as {status.stdout.splitlines()[0][3:]}"
        )
    _check_placeholders(root)
    changelog = cut_changelog(_read(root, CHANGELOG), version, day)
    texts = {
        CHANGELOG: changelog,
        PROJECT: _VERSION_LINES[PROJECT].sub(f'version = "{version}"\n', _read(root, PROJECT), count=1),
        CITATION: _VERSION_LINES[CITATION].sub(
            f"version: {version}\ndate-released: {day.isoformat()}\n", _read(root, CITATION), count=1
        ),
    }
    for name, text in texts.items():
        (root / name).write_text(text, encoding="utf-8")
    return notes(root, version)


def notes(root: Path, version: str) -> str:
    """Return the release notes of the version that the files of a checkout are at.

    Raises:
        ValueError: a file is at another version, the changelog has no section of it, or there are placeholders.
    """
    _check_placeholders(root)
    for name, line in _VERSION_LINES.items():
        stated = line.search(_read(root, name))
        if stated is None or stated["version"] != version:
            raise ValueError(f"{name}: has version {stated and stated['version']}, expected is {version}")
    sections = changelog_sections(_read(root, CHANGELOG))
    if version not in sections:
        raise ValueError(f"{CHANGELOG}: has no section {version}, only {', '.join(sections)}")
    return sections[version]


def _check_placeholders(root: Path) -> None:
    for name in (PROJECT, CITATION):
        for number, line in enumerate(_read(root, name).splitlines(), 1):
            for word in PLACEHOLDERS:
                # A comment may explain them.
                if word in line.partition("#")[0]:
                    raise ValueError(f"{name}: line {number} has the placeholder {word}; write what is true instead")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


def _read(root: Path, name: str) -> str:
    return (root / name).read_text(encoding="utf-8")


def main(words: list[str]) -> int:
    """Run the command line; return the exit code."""
    root = Path(__file__).resolve().parents[1]
    try:
        match words:
            case ["cut", version]:
                print(cut(root, version, date.today()))
                print(f"next: git commit -am 'Release {version}' && git tag v{version}", file=sys.stderr)
            case ["notes", version]:
                print(notes(root, version))
            case _:
                raise ValueError(f"got {' '.join(words) or 'no words'}, allowed are cut VERSION and notes VERSION")
    except ValueError as error:
        print(f"release: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
