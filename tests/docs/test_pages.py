import json
import re
from pathlib import Path

import pytest

from padforge.design.contact_set import judged_contacts
from padforge.design.objectives import bayes_error
from padforge.design.settings import Contact, SearchSettings
from padforge.sense.health.health_model import MIN_PRESSES
from padforge.sense.localizer import moments, press_sampler
from padforge.sense.localizer.features import N_TIMED
from padforge.sense.settings import LocalizerSettings
from tests.docs.pages import BLOCK, PAGES, ROOT, relative

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def read(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_and_pictures_exist_and_no_path_of_a_machine(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in LINK.findall(BLOCK.sub("", text)):
        if "://" in target or target.startswith("mailto:"):
            continue
        name, _, anchor = target.partition("#")
        there = page.parent / name if name else page
        assert there.exists(), f"{relative(page)}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", there.read_text(encoding="utf-8")), re.MULTILINE)
            anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in anchors, f"{relative(page)}: {target}"
    assert str(ROOT) not in text
    assert not re.search(r"(?<![\w.:/])/(work|home|tmp|opt|root|Users|mnt)/", text)
    assert not re.search(r"\b[A-Z]:\\", text)


def test_readme_devcontainer_and_pre_commit_agree_and_workflows_name_actions_by_commit() -> None:
    """The README's with `-e`; the ruff of the constraints. A tag may be moved; its version is beside the commit."""
    line = re.search(r"<!-- tests -->\n```sh\n(.*) && [^&]*pytest", read("README.md"))
    assert line
    container = json.loads(read(".devcontainer/devcontainer.json"))
    assert container["postCreateCommand"] == line[1].replace("'.[test]'", "-e '.[test]'")
    pinned = re.search(r"^ruff==(\S+)$", read("constraints.txt"), re.MULTILINE)
    hooked = re.search(r"rev: v(\S+)", read(".pre-commit-config.yaml"))
    assert pinned
    assert hooked
    assert hooked[1] == pinned[1]
    paths = (ROOT / ".github" / "workflows").glob("*.yml")
    used = [line for path in paths for line in re.findall(r"uses: (.*)", path.read_text())]
    actions = [action for action in used if not action.startswith("./")]
    assert len(actions) > 10
    for action in actions:
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action), action


def test_presses_of_pages_suffice_for_health_and_are_those_of_their_table() -> None:
    """Of the recording that is then calibrated; the text names the least that does."""
    text, share = read("docs/howto-by-hand.md"), 1 - LocalizerSettings().test_share
    [presses] = re.findall(r"--presses (\d+) --out out/mine", text)
    [least] = re.findall(r"Fewer than (\d+)", text)
    assert round(share * int(least)) == MIN_PRESSES <= share * int(presses)
    assert f"{presses} presses take about" in text
    text = read("docs/tutorial-sense.md")
    assert re.findall(r"error in mm on (\d+) presses", text)[0] == re.findall(r"The table evaluates (\d+) ", text)[0]


def section(title: str) -> str:
    return " ".join(read("docs/method.md").partition(f"{title}\n")[2].partition("\n##")[0].split())


def test_method_describes_the_program_that_there_is() -> None:
    text = section("## Errors under another contact")
    for name in judged_contacts(Contact(), SearchSettings()):
        assert f"| {name} |" in text
    text = section("## Expected error")
    assert f"over {bayes_error.PRESSES} simulated presses" in text
    assert f"the expected error is {bayes_error.LEARNING:g} times that of the rule" in text
    phases, (slow, fast) = moments.PHASES[N_TIMED], press_sampler.SPEEDS_MM_S
    assert {name: phase.sliding for name, phase in phases.items() if phase.sliding} == {"touched": 0.3}
    assert "strokes: in three of ten presses of the touch" in section("## From presses to positions")
    assert f"at {slow:g} to {fast:g} mm/s" in section("## From presses to positions")


def test_page_on_the_paper_has_a_row_for_all_of_it_with_code_or_why_not() -> None:
    lines = [line for line in read("docs/paper.md").splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    text = " ".join(row[0] for row in rows)
    numbers = {int(number) for part in re.findall(r"Figures? ([\d, ]+)", text) for number in part.split(",") if number}
    assert numbers == set(range(1, 15))
    assert set(re.findall(r"\((\d)\)", text)) == set("123456")
    assert set(re.findall(r"Table (I+)", text)) == {"I", "II", "III"}
    for row in rows:
        assert len(row) == 3
        if row[2] not in ("here", "---"):
            assert "`" in row[2] or "not built, because" in row[2], row
