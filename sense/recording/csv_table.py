"""CSV files of any program as numbers: whatever is none is one clear line.

Values are separated by commas, semicolons or tabs, whichever the header has most of; where they are not separated by
commas, a comma is a decimal point. Lines that begin with # are comments; the last of them is the header where only
numbers follow. An empty cell is missing."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from padforge.design.common.files import check_file
from padforge.design.common.validation import MAX_VALUES, InputError
from padforge.sense.arrays import MAX_BYTES, Array

UNKNOWN = -1.7e308
"""Stands for `?` among numbers; far beyond any of them."""
_PIECE, _LONGEST = 2**23, 2**20
"""How much is read at a time, and the longest line, characters."""


class CsvTable:
    """A CSV file whose header has been read.

    Args:
        gaps: whether empty lines between others are nothing, rather than lines without values.

    Attributes:
        path: of the file. names: what the header says of each column, without spaces around.

    Raises:
        InputError: the file cannot be read, or is no CSV.
    """

    def __init__(self, path: Path, gaps: bool = False) -> None:
        self.path, self._gaps = check_file(path, MAX_BYTES), gaps
        with _reading(self.path) as file:
            self._skipped, header = _header(file)
            self._separator = _separator(header)
            self.names = [name.strip() for name in self._cells(header.rstrip("\n"))]
        self._passed: list[int] = []

    def columns(self, numbers: Sequence[int], unknown: Sequence[int] = ()) -> Array:
        """Columns of the table, (R, n), in the order of their `numbers` from 0; NaN where a cell is empty.

        Args:
            unknown: those of `numbers` whose cells may be `?`, which is given as UNKNOWN.

        Raises:
            InputError: a line of more or fewer cells, one that holds no number there, or more than MOST_VALUES in all;
                the message names the line.
        """
        parts, size = [np.empty((0, len(numbers)))], 0
        self._passed = []
        with _reading(self.path) as file:
            for _ in range(self._skipped):
                file.readline(_LONGEST)
            for first, text in self._pieces(file):
                part = self._at_once(text, numbers, unknown)
                parts.append(self._line_by_line(first, text, numbers, unknown) if part is None else part)
                size += parts[-1].size
                if size > MAX_VALUES:
                    raise InputError(f"{self.path}: holds more than {MAX_VALUES} values, allowed are so many")
        return np.concatenate(parts)

    def line(self, row: int) -> int:
        """Number of the line, from 1, that a row of `columns` was read from."""
        number = self._skipped + 1 + row
        for passed in self._passed:
            number += passed <= number
        return number

    def _cells(self, line: str) -> list[str]:
        return next(csv.reader([line], delimiter=self._separator, strict=True), [])

    def _pieces(self, file: TextIO) -> Iterator[tuple[int, str]]:
        """Whole lines and the number of the first of them; empty lines at the end are left out."""
        first, left = self._skipped + 1, ""
        while read := file.read(_PIECE):
            rest = file.readline(_LONGEST)
            if len(rest) == _LONGEST:
                raise InputError(f"{self.path}: a line has more than {_LONGEST} characters, allowed are so many")
            text = left + read + rest
            whole = text.rstrip("\n")
            left = text[len(whole) + bool(whole) :]
            if whole:
                yield first, whole
                first += whole.count("\n") + 1

    def _at_once(self, text: str, numbers: Sequence[int], unknown: Sequence[int]) -> Array | None:
        """The numbers in lines that are as plain as those of most files; None where they are not."""
        if not text.isascii() or '"' in text or text.startswith("#") or "\n#" in text:
            return None
        separator = self._separator
        codes = np.frombuffer(text.encode(), np.uint8)
        ends = np.append(np.flatnonzero(codes == ord("\n")), len(codes))
        cells = np.diff(np.searchsorted(np.flatnonzero(codes == ord(separator)), ends), prepend=0) + 1
        if (cells != len(self.names)).any():
            return None
        if separator != ",":
            text = text.replace(",", ".")
        for before, after in ((separator, separator), (separator, separator), (separator, "\n"), ("\n", separator)):
            text = text.replace(before + after, f"{before}nan{after}")
        text = "nan" * text.startswith(separator) + text + "nan" * text.endswith(separator)
        if "?" in text:
            text = text.replace("?", f"{UNKNOWN} ")  # the space keeps ?5 from being a number
        try:
            found = np.loadtxt(io.StringIO(text), delimiter=separator, comments=None, usecols=numbers, ndmin=2)
        except ValueError:
            return None
        strange = (found == UNKNOWN).any(axis=0) & ~np.isin(numbers, unknown)
        return None if strange.any() or len(found) != len(ends) else found

    def _line_by_line(self, first: int, text: str, numbers: Sequence[int], unknown: Sequence[int]) -> Array:
        """The same of any lines; their numbers begin with `first`."""
        rows = []
        for number, line in enumerate(text.split("\n"), first):
            if line.startswith("#") or (self._gaps and not line):
                self._passed.append(number)
                continue
            try:
                cells = self._cells(line)
            except csv.Error as error:
                raise InputError(f"{self.path}: line {number} is not CSV ({error})") from error
            if len(cells) != len(self.names):
                raise InputError(f"{self.path}: line {number} has {len(cells)} values, expected {len(self.names)}")
            try:
                rows.append([self._number(cells[each], each in unknown) for each in numbers])
            except ValueError as error:
                raise InputError(f"{self.path}: line {number} holds no numbers ({error})") from error
        return np.array(rows).reshape(-1, len(numbers))

    def _number(self, cell: str, unknown: bool) -> float:
        cell = cell.strip()
        if unknown and cell == "?":
            return UNKNOWN
        return _number(cell if self._separator == "," else cell.replace(",", ".")) if cell else np.nan


@contextmanager
def _reading(path: Path) -> Iterator[TextIO]:
    """A CSV file open for reading; what is wrong with it is an InputError."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield file
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV file ({error})") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _header(file: TextIO) -> tuple[int, str]:
    """How many lines come before those of numbers, and the header among them."""
    comment = ""
    for skipped, line in enumerate(iter(lambda: file.readline(_LONGEST), "")):
        if line.startswith("#"):
            comment = line.lstrip("#")
        elif line.strip():
            cells = next(csv.reader([line], delimiter=_separator(comment)))
            return (skipped, comment.strip()) if comment and all(map(_is_number, cells)) else (skipped + 1, line)
    return 0, ""


def _separator(line: str) -> str:
    unquoted = re.sub('"[^"]*"', "", line)
    return max(",;\t", key=unquoted.count)


def _is_number(cell: str) -> bool:
    try:
        _number(cell.strip().replace(",", ".") or "nan")
    except ValueError:
        return False
    return True


def _number(cell: str) -> float:
    """A number as programs write them: Python's float takes 1_0 and digits of other scripts as well."""
    if "_" in cell or not cell.isascii():
        raise ValueError(f"could not convert string to float: {cell!r}")
    return float(cell)
