"""Columns of numbers from CSV files of any program.

Values are separated by commas, semicolons or tabs, whichever the header has most of; without commas as separators, a
comma is a decimal point. Lines that begin with # are comments; the last one is the header if only numbers follow. An
empty cell is missing.
"""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from padforge.design.common.files import check_file
from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_BYTES, Array

UNKNOWN = -1.7e308
"""Stands for `?` among numbers, far from all others."""
_BATCH = 2**23  # characters that are read at a time


class CsvTable:
    """A CSV file whose header, `names`, has been read; with `skip_empty`, empty lines between others are skipped."""

    def __init__(self, path: Path, skip_empty: bool = False) -> None:
        self.path, self._skip_empty = check_file(path, MAX_BYTES), skip_empty
        with _open_csv(self.path) as file:
            self._n_header, header = _read_header(file)
            self._separator = _find_separator(header)
            self.names = [name.strip() for name in self._split(header.rstrip("\n"))]
        self._skipped: list[int] = []

    def read_columns(self, columns: Sequence[int], may_be_unknown: Sequence[int] = ()) -> Array:
        """Return columns by their indices (R, n), NaN where a cell is empty; `?` is UNKNOWN where it is allowed."""
        parts = [np.empty((0, len(columns)))]
        self._skipped = []
        with _open_csv(self.path) as file:
            for _ in range(self._n_header):
                file.readline()
            for number, text in self._read_batches(file):
                part = self._parse_plain(text, columns, may_be_unknown)
                parts.append(self._parse_lines(number, text, columns, may_be_unknown) if part is None else part)
        return np.concatenate(parts)

    def line_number(self, row: int) -> int:
        """Return the number of the line, from 1, that a row was read from."""
        number = self._n_header + 1 + row
        for skipped in self._skipped:
            number += skipped <= number
        return number

    def _split(self, line: str) -> list[str]:
        return next(csv.reader([line], delimiter=self._separator, strict=True), [])

    def _read_batches(self, file: TextIO) -> Iterator[tuple[int, str]]:
        """Yield complete lines, and the number of the first of them; empty lines at the end are left out."""
        number, newlines = self._n_header + 1, ""
        while batch := file.read(_BATCH):
            batch = newlines + batch + file.readline()
            text = batch.rstrip("\n")
            newlines = batch[len(text) + bool(text) :]
            if text:
                yield number, text
                number += text.count("\n") + 1

    def _parse_plain(self, text: str, columns: Sequence[int], may_be_unknown: Sequence[int]) -> Array | None:
        """Parse lines at once by NumPy, if they are as plain as in most files; else return None."""
        if not text.isascii() or '"' in text or text.startswith("#") or "\n#" in text:
            return None
        separator = self._separator
        codes = np.frombuffer(text.encode(), np.uint8)
        ends = np.append(np.flatnonzero(codes == ord("\n")), len(codes))
        n_cells = np.diff(np.searchsorted(np.flatnonzero(codes == ord(separator)), ends), prepend=0) + 1
        if (n_cells != len(self.names)).any():
            return None
        if separator != ",":
            text = text.replace(",", ".")
        for before, after in ((separator, separator), (separator, separator), (separator, "\n"), ("\n", separator)):
            text = text.replace(before + after, f"{before}nan{after}")
        text = "nan" * text.startswith(separator) + text + "nan" * text.endswith(separator)
        text = text.replace("?", f"{UNKNOWN} ")  # the space keeps ?5 from being a number
        try:
            values = np.loadtxt(io.StringIO(text), delimiter=separator, comments=None, usecols=columns, ndmin=2)
        except ValueError:
            return None
        has_unknown = (values == UNKNOWN).any(axis=0)
        return None if (has_unknown & ~np.isin(columns, may_be_unknown)).any() or len(values) != len(ends) else values

    def _parse_lines(self, first: int, text: str, columns: Sequence[int], may_be_unknown: Sequence[int]) -> Array:
        """Parse lines one by one; the number of the first is `first`."""
        rows = []
        for number, line in enumerate(text.split("\n"), first):
            if line.startswith("#") or (self._skip_empty and not line):
                self._skipped.append(number)
                continue
            try:
                cells = self._split(line)
            except csv.Error as error:
                raise InputError(f"{self.path}: line {number} is not CSV ({error})") from error
            if len(cells) != len(self.names):
                raise InputError(f"{self.path}: line {number} has {len(cells)} values, expected {len(self.names)}")
            try:
                rows.append([self._parse_cell(cells[column], column in may_be_unknown) for column in columns])
            except ValueError as error:
                raise InputError(f"{self.path}: line {number} holds no numbers ({error})") from error
        return np.array(rows).reshape(-1, len(columns))

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
    """Parse a number as programs write them; float() would take 1_0 and digits of other scripts as well."""
    if "_" in cell or not cell.isascii():
        raise ValueError(f"could not convert string to float: {cell!r}")
    return float(cell)
