"""Links of the documentation lead somewhere, and no page knows the machine it was written on."""

import json
import re
from pathlib import Path

import pytest

from tests.docs.pages import BLOCK, PAGES, ROOT, relative

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_and_pictures_exist(page: Path) -> None:
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
def test_pages_name_no_path_of_a_machine(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert str(ROOT) not in text
    assert not re.search(r"(?<![\w.:/])/(work|home|tmp|opt|root|Users|mnt)/", text)
    assert not re.search(r"\b[A-Z]:\\", text)


def test_devcontainer_installs_as_the_readme_does_for_development() -> None:
    """The README's command for tests, with `-e`."""
    line = re.search(r"<!-- tests -->\n```sh\n(.*) && [^&]*pytest", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert line
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    assert container["postCreateCommand"] == line[1].replace("'.[test]'", "-e '.[test]'")


def test_pre_commit_runs_the_ruff_of_the_constraints() -> None:
    pinned = re.search(r"^ruff==(\S+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    hooked = re.search(r"rev: v(\S+)", (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    assert pinned
    assert hooked
    assert hooked[1] == pinned[1]
