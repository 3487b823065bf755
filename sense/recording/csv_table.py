"""Columns of numbers from CSV files of any program.

Values are separated by commas, semicolons or tabs, whichever the header has most of; without commas as separators, a
comma is a decimal point. Lines that begin with # are comments; the last one is the header if only numbers follow. Empty
lines are skipped; an empty cell is missing.
"""

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TextIO

import numpy as np

from padforge.common.files import check_file
from padforge.common.validation import InputError
from padforge.sense.arrays import MAX_BYTES, Array

UNKNOWN = -1.7e308
"""Stands for `?` among numbers, far from all others."""


class CsvTable:
    """A CSV file whose header, `names`, has been read."""

    def __init__(self, path: Path) -> None:
        self.path = check_file(path, MAX_BYTES)
        with _open_csv(self.path) as file:
            self._n_header, header = _read_header(file)
            self._separator = _find_separator(header)
            self.names = [name.strip() for name in self._split(header.rstrip("\n"))]
        self._skipped: list[int] = []

    def read_columns(self, columns: Sequence[int], may_be_unknown: Sequence[int] = ()) -> Array:
        """Return columns by their indices (R, n), NaN where a cell is empty; `?` is UNKNOWN where it is allowed."""
        self._skipped = []
        with _open_csv(self.path) as file:
            rows = self._parse_rows(file, columns, may_be_unknown)
            return np.fromiter(chain.from_iterable(rows), np.float64).reshape(-1, len(columns))

    def line_number(self, row: int) -> int:
        """Return the number of the line, from 1, that a row was read from."""
        number = self._n_header + 1 + row
        for skipped in self._skipped:
            number += skipped <= number
        return number

    def _split(self, line: str) -> list[str]:
        return next(csv.reader([line], delimiter=self._separator, strict=True), [])

    def _parse_rows(self, file: TextIO, columns: Sequence[int], may_be_unknown: Sequence[int]) -> Iterator[list[float]]:
        """Yield the numbers of each line after the header."""
        for number, line in enumerate(file, 1):
            line = line.rstrip("\n")
            if number <= self._n_header:
                continue
            if line.startswith("#") or not line:
                self._skipped.append(number)
                continue
            try:
                cells = self._split(line)
            except csv.Error as error:
                raise InputError(f"{self.path}: line {number} is not CSV ({error})") from error
            if len(cells) != len(self.names):
                raise InputError(f"{self.path}: line {number} has {len(cells)} values, expected {len(self.names)}")
            try:
                yield [self._parse_cell(cells[column], column in may_be_unknown) for column in columns]
            except ValueError as error:
                raise InputError(f"{self.path}: line {number} holds no numbers ({error})") from error

    def _parse_cell(self, cell: str, may_be_unknown: bool) -> float:
        cell = cell.strip()
        if may_be_unknown and cell == "?":
            return UNKNOWN
        return _parse_number(cell if self._separator == "," else cell.replace(",", ".")) if cell else np.nan


@contextmanager
def _open_csv(path: Path) -> Iterator[TextIO]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield file
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV file ({error})") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _read_header(file: TextIO) -> tuple[int, str]:
    """Return the number of lines before those of numbers, and the header among them."""
    comment = ""
    for index, line in enumerate(file):
        if line.startswith("#"):
            comment = line.lstrip("#")
        elif line.strip():
            cells = next(csv.reader([line], delimiter=_find_separator(comment)))
            return (index, comment.strip()) if comment and all(map(_is_number, cells)) else (index + 1, line)
    return 0, ""


def _find_separator(line: str) -> str:
    return max(",;\t", key=re.sub('"[^"]*"', "", line).count)


def _is_number(cell: str) -> bool:
    try:
        _parse_number(cell.strip().replace(",", ".") or "nan")
    except ValueError:
        return False
    return True


def _parse_number(cell: str) -> float:
    """Parse a number as programs write them; float() would take 1_0 as well."""
    if "_" in cell:
        raise ValueError(f"could not convert string to float: {cell!r}")
    return float(cell)
