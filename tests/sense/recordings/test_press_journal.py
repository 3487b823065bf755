"""What a journal that is torn or damaged tells of the presses."""

from pathlib import Path

import pytest

from design.common.errors import InputError
from sense import Recording


def test_a_torn_journal_line_loses_its_press_only(recording: Recording, folder: Path) -> None:
    journal = folder / "journal.ndjson"
    journal.write_text(journal.read_text()[:-9])
    assert len(Recording.open(folder).presses_mm) == len(recording.presses_mm) - 1


def test_a_damaged_journal_is_one_clear_error(folder: Path) -> None:
    journal = folder / "journal.ndjson"
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join([*lines[:4], lines[4].replace("begun", "began"), *lines[5:]]))
    with pytest.raises(InputError, match="line 5 is no journal entry"):
        Recording.open(folder)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *(
            ('"reading": 20,', f'"reading": {value},')
            for value in ("1e999", "1e30", "20.0", "true", '"20"', "-1", "NaN")
        ),
        *(('"press": 0,', f'"press": {value},') for value in ("1e999", "0.0", "false", '"0"', "null", "9" * 30)),
        *(('"x_mm": ', f'"x_mm": {value}, "was": ') for value in ("1e999", "1e6", "true", '"2"')),
        ('"event": "begun", ', ""),
        ('{"event"', "[" * 100_000 + '{"event"'),
        ('{"event"', '3\n{"event"'),
    ],
)
def test_a_journal_entry_of_other_values_is_refused(folder: Path, old: str, new: str) -> None:
    journal = folder / "journal.ndjson"
    text = journal.read_text()
    assert old in text
    journal.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=r"journal\.ndjson: line 1 is no journal entry") as caught:
        Recording.open(folder)
    assert len(str(caught.value)) < 400
