import re
import runpy
import subprocess
import tomllib
from datetime import date
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
release = SimpleNamespace(**runpy.run_path(str(ROOT / ".github" / "release.py")))
DAY = date(2030, 1, 2)
OLDER = "# Changelog\n\nIntroduction.\n\n## Unreleased\n\n### Added\n\n- Pads.\n\n## 0.1.0 - 2029-12-31\n\n- Moulds.\n"
FILES = {
    "CHANGELOG.md": OLDER,
    "pyproject.toml": '[project]\nname = "pad"\nversion = "0.1.0"\n# OWNER is a placeholder\ntool = 1\n',
    "CITATION.cff": "title: pad\nversion: 0.1.0\ndate-released: 2029-12-31\nlicense: MIT\n",
}


def commit(folder: Path) -> None:
    for words in ("init -q", "add .", "-c user.name=a -c user.email=a@b commit -q -m Pads"):
        subprocess.run(["git", *words.split()], cwd=folder, check=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    commit(tmp_path)
    return tmp_path


def texts(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text() for name in FILES}


def test_cut_writes_the_version_everywhere_and_returns_its_notes(checkout: Path) -> None:
    assert release.cut(checkout, "0.2.0", DAY) == "### Added\n\n- Pads."
    after = texts(checkout)
    assert after["CHANGELOG.md"] == OLDER.replace("## Unreleased\n", "## Unreleased\n\n## 0.2.0 - 2030-01-02\n")
    assert after["pyproject.toml"] == FILES["pyproject.toml"].replace("0.1.0", "0.2.0")
    assert after["CITATION.cff"] == "title: pad\nversion: 0.2.0\ndate-released: 2030-01-02\nlicense: MIT\n"
    assert release.notes(checkout, "0.2.0") == "### Added\n\n- Pads."
    with pytest.raises(ValueError, match=r"has version 0\.2\.0, expected is 0\.1\.0"):
        release.notes(checkout, "0.1.0")


REFUSED = [
    ("0.2", {}, "version: got 0.2, allowed is X.Y.Z"),
    ("0.1.0", {}, "got 0.1.0, allowed is one above 0.1.0"),
    ("0.2.0", {"CHANGELOG.md": "## Unreleased\n\nNothing yet.\n\n## 0.1.0\n"}, "nothing under Unreleased"),
    ("0.2.0", {"pyproject.toml": 'version = "0.1.0"\nurl = "//OWNER"\n'}, "toml: line 2 has the placeholder OWNER"),
    ("0.2.0", {"CITATION.cff": "version: 0.1.0\nat: a@example.org\n"}, "cff: line 2 has the placeholder example.org"),
]


@pytest.mark.parametrize(("version", "changed", "said"), REFUSED)
def test_cut_is_refused_and_changes_nothing(checkout: Path, version: str, changed: dict[str, str], said: str) -> None:
    for name, text in changed.items():
        (checkout / name).write_text(text)
        with pytest.raises(ValueError, match=f"not committed, such as {name}"):
            release.cut(checkout, "0.2.0", DAY)
        commit(checkout)
    before = texts(checkout)
    with pytest.raises(ValueError, match=rf"^[^\n]*{re.escape(said)}[^\n]*$"):
        release.cut(checkout, version, DAY)
    assert texts(checkout) == before


def test_files_of_the_project_agree_on_its_version(tmp_path: Path) -> None:
    """Apart from placeholders, what was cut of them would have notes."""
    for name in FILES:
        text = re.sub("|".join(release.PLACEHOLDERS), "true", (ROOT / name).read_text(encoding="utf-8"))
        (tmp_path / name).write_text(text, encoding="utf-8")
    version = tomllib.loads((tmp_path / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    changelog = (tmp_path / "CHANGELOG.md").read_text(encoding="utf-8")
    assert next(iter(release.changelog_sections(changelog))) == "Unreleased"
    if version not in release.changelog_sections(changelog):  # before the first release
        (tmp_path / "CHANGELOG.md").write_text(release.cut_changelog(changelog, version, DAY), encoding="utf-8")
    assert "- " in release.notes(tmp_path, version)
