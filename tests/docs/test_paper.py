"""The page on the paper leaves nothing of it out."""

import re

from tests.docs.pages import ROOT

ROWS = [
    [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in (ROOT / "docs" / "paper.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("| ")
]


def test_every_equation_figure_and_table_has_a_row() -> None:
    text = " ".join(row[0] for row in ROWS)
    numbers = {int(number) for part in re.findall(r"Figures? ([\d, ]+)", text) for number in part.split(",") if number}
    assert numbers == set(range(1, 15))
    assert set(re.findall(r"\((\d)\)", text)) == set("123456")
    assert set(re.findall(r"Table (I+)", text)) == {"I", "II", "III"}


def test_every_row_has_code_or_says_why_not() -> None:
    for row in ROWS:
        assert len(row) == 3
        if row[2] not in ("here", "---"):
            assert "`" in row[2] or "not built, because" in row[2], row
