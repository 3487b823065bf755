"""Columns of numbers from text tables of programs, loggers and spreadsheets.

The dialect of a table is detected from its first lines: the encoding by the byte order mark, the separator as the one
that gives most numbers, the header as the last line of names before the numbers, and whether commas are decimal points.
A line of units may follow the header, and any lines may precede it. Lines are split by the module csv.
"""

import codecs
import csv
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from padforge.common.files import check_file
from padforge.common.validation import InputError, short_repr
from padforge.sense.arrays import MAX_BYTES, Array

UNKNOWN = -1.7e308  # represents `?` among numbers, and is far from all others
MISSING = {"", "nan", "na", "n/a", "#n/a", "#na", "null", "none", "-", "--", "inf", "-inf", "+inf", "#num!", "#value!"}
MISSING |= {"ovf", "overflow", "over", "ol", "#div/0!", "missing", "infinity", "-infinity", "nan(ind)", "-nan"}
"""Words for a value that is missing or out of range, in lower case."""
SEPARATORS = ",;\t| "
FALLBACK = "cp1252"  # encoding of text that is not UTF-8: that of Windows in western Europe and America
_TRUTH = {"true": 1.0, "false": 0.0, "yes": 1.0, "no": 0.0, "on": 1.0, "off": 0.0}
_BYTE_ORDER_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_N_SAMPLED = 400  # lines from which the dialect is detected
_MAX_NAMED = 5  # lines in a message
_MONITOR = re.compile(r"^(\d{1,2}:\d\d:\d\d(?:[.,]\d+)?) -> ?")  # time stamps of the Arduino IDE's monitor
_GARBAGE = re.compile("^[\x00-\x08\x0e-\x1f\x7f-\xff\ufffd]*[\x00-\x08\x0e-\x1f\xfe\xff\ufffd]")  # sent while booting
_CLOCK = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d(?:[.,]\d+)?))?")
_DATE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[T ,]+\d{1,2}:\d\d.*|\d{1,2} \w{3} \d{4} .*|" + _CLOCK.pattern)
_MEASURED = re.compile(
    r"(?:([A-Za-z]\w*) ?[:=] ?)?([-+]?[.,]?\d[\d.,]*(?:[eE][-+]?\d+)?) ?((?![eE]$)[a-zA-Zµμ°%Ω]{1,4})?"
)
"""A number with its name before it, as for the Arduino IDE's plotter, or its unit behind it: `left:1.84`, `0.05 s`."""
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(,\d{3})+(\.\d*)?")


@dataclass(frozen=True)
class _Dialect:
    """Format of a table."""

    separator: str
    decimal_comma: bool
    header: int  # number of the line of names, from 1; 0 if there is none
    first: int  # number of the first line of values
    width: int  # most frequent number of values in a line; a header may have more
    names: list[str]
    units: list[str]
    dates: frozenset[int]  # indices of columns of dates or times of day


@dataclass
class Table:
    """A table whose columns are read by their indices."""

    path: Path
    encoding: str
    names: list[str]  # names of the columns; numbers from 1 if there is no header
    units: list[str]  # units of the columns, from a line below the header; "" if there is none
    rows: list[list[str]]  # cells of the first lines, for people
    dialect: _Dialect
    notes: list[str] = field(default_factory=list)  # a line for each omission in reading
    _lines: "array[int]" = field(default_factory=lambda: array("q"))  # number of the line of each row

    @property
    def has_header(self) -> bool:
        """Whether a line names the columns."""
        return self.dialect.header > 0 or any(not name.isdecimal() for name in self.names)

    def line_number(self, row: int) -> int:
        """Return the number of the line, from 1, that a row was read from."""
        return self._lines[row]

    def read_columns(self, columns: Sequence[int], may_be_unknown: Sequence[int] = ()) -> Array:
        """Return the numbers (R, n) in n columns, by their indices; NaN where missing.

        Dates are seconds since 1970, and times of day seconds since midnight. In columns that `may_be_unknown`, `?` is
        read as `UNKNOWN`.
        """
        dialect, width = self.dialect, len(self.names)
        numbers, self._lines, self.notes = array("d"), array("q"), []
        dates: dict[int, list[str]] = {column: [] for column in columns if column in dialect.dates}
        words: dict[int, dict[int, str]] = {column: {} for column in columns}  # invalid cells by column and line
        torn: list[tuple[int, int]] = []  # lines with a wrong number of values, and that number
        # lines with too many values: the row that would follow, the number of the line, and its last `width` cells
        ends: list[tuple[int, int, list[str]]] = []
        garbled: list[int] = []
        n_headers = last = 0
        for line, row in _split(_iterate_lines(self.path, self.encoding, garbled=garbled), dialect.separator):
            if line < dialect.first:
                continue
            last = line
            cells = [cell.strip() for cell in row]
            if len(cells) == dialect.width < width:  # fill the columns of a wider header
                cells += [""] * (width - dialect.width)
            elif not any(cells[width:]):  # drop empty cells at the end
                cells = cells[:width]
            if len(cells) != width:
                torn.append((line, len(cells)))
                if width < len(cells) < 2 * width:
                    ends.append((len(self._lines), line, cells[-width:]))
            elif not any(cells):
                continue
            elif self.has_header and cells in (self.names, self.units):
                n_headers += 1
            else:
                self._lines.append(line)
                for column in columns:
                    if column in dates:
                        dates[column].append(cells[column])
                        value = np.nan  # filled in below
                    elif (value := _parse(cells[column], dialect, column, column in may_be_unknown)) is None:
                        words[column][line], value = cells[column], np.nan
                    numbers.append(value)
        if not self._lines:
            raise InputError(f"{self.path}: has no line of values below its header")
        values = np.frombuffer(numbers, np.float64).reshape(-1, len(columns))
        for column, texts in dates.items():
            values[:, list(columns).index(column)] = _parse_dates(texts, f"{self.path}: {self.names[column]}")
        values, joined = self._insert_ends(values, columns, ends)
        self._report(words, [item for item in torn if item[0] not in joined], n_headers, last)
        if joined:
            self.notes.append(f"{name_lines(joined)} read from where another line begins in it: one was cut off")
        if garbled:
            self.notes.append(f"{name_lines(garbled)} read without its bytes that are not text")
        if self.encoding == FALLBACK:
            self.notes.append(f"its text is not UTF-8 and was read as {FALLBACK} (--encoding names another)")
        return values

    def _insert_ends(
        self, values: Array, columns: Sequence[int], ends: list[tuple[int, int, list[str]]]
    ) -> tuple[Array, list[int]]:
        """Insert rows that were written into the line of a row that was cut off; return the values and these lines.

        No separator precedes the first cell of such a row. Where it begins is certain only if the first column ascends,
        and one number alone fits between those above and below.
        """
        if not ends or 0 not in columns:
            return values, []
        first = list(columns).index(0)
        if (np.diff(values[:, first]) < 0).any():
            return values, []
        rows, inserted, joined = list[int](), list[list[float]](), list[int]()
        bounds = [-np.inf, *values[:, first], np.inf]
        for row, line, cells in ends:
            starts = [_parse(cells[0][i:], self.dialect, 0, may_be_unknown=False) for i in range(len(cells[0]))]
            between = {start for start in starts if start is not None and bounds[row] < start < bounds[row + 1]}
            numbers = [_parse(cells[column], self.dialect, column, may_be_unknown=False) for column in columns]
            numbers[first] = between.pop() if len(between) == 1 else None
            if (complete := [number for number in numbers if number is not None]) == numbers:
                self._lines.insert(row + len(rows), line)
                rows, inserted, joined = [*rows, row], [*inserted, complete], [*joined, line]
        return np.insert(values, rows, np.reshape(inserted, (-1, len(columns))), axis=0), joined

    def _report(self, words: dict[int, dict[int, str]], torn: list[tuple[int, int]], n_headers: int, last: int) -> None:
        """Add notes on what was omitted; raise InputError if it is too much."""
        limit = max(3, 0.05 * len(self._lines))  # more indicate a wrong dialect
        if len(torn) > limit:
            line, n_values = torn[0]
            raise InputError(f"{self.path}: line {line} has {n_values} values, expected {len(self.names)}")
        if torn and torn[-1][0] == last:
            self.notes.append(f"line {torn.pop()[0]}, the last, is cut off and left out")
        if torn:
            counts = ", ".join(dict.fromkeys(str(n_values) for _, n_values in torn))
            what = f"{counts} values, expected {len(self.names)}"
            self.notes.append(f"{name_lines([line for line, _ in torn])} left out: {what}")
        if n_headers:
            self.notes.append(f"{n_headers} repeated header lines are left out")
        for column, cells in words.items():
            if cells:
                line, word = next(iter(cells.items()))
                what = f"column {short_repr(self.names[column])} holds no number but {short_repr(word)}"
                if len(cells) > limit:
                    raise InputError(f"{self.path}: line {line}: {what}")
                self.notes.append(f"{name_lines(list(cells))} read with a value missing: {what}")


def name_lines(lines: Sequence[int]) -> str:
    """Name lines by their numbers, as "line 3 is" or "lines 3, 4 and 2 more are"."""
    named = ", ".join(map(str, lines[:_MAX_NAMED]))
    more = f" and {len(lines) - _MAX_NAMED} more" if len(lines) > _MAX_NAMED else ""
    return f"lines {named}{more} are" if len(lines) > 1 else f"line {named} is"


def read_table(path: Path, encoding: str = "") -> Table:
    """Open a table; its columns are read by `Table.read_columns`.

    The encoding is by default that of the byte order mark, UTF-8 if the text is valid, or Windows' cp1252. Raises
    InputError if the file cannot be read, or is not text.
    """
    encoding = encoding or _find_encoding(check_file(path, MAX_BYTES))
    sample = list(islice(_iterate_lines(path, encoding, comments=True), _N_SAMPLED))
    dialect = _find_dialect(sample)
    blank = [""] * len(dialect.names)
    lines = _split(iter(sample), dialect.separator)
    rows = [[*row, *blank][: len(blank)] for line, row in lines if line >= dialect.first]
    return Table(path, encoding, dialect.names, dialect.units, rows, dialect)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except LookupError as error:
        raise InputError(f"--encoding: {error}") from error
    except (UnicodeError, csv.Error) as error:
        raise InputError(f"{path}: no table of text ({error}); --encoding names another encoding") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _find_encoding(path: Path) -> str:
    with _readable(path), path.open("rb") as file:
        start = file.read(400)
        for mark, encoding in _BYTE_ORDER_MARKS.items():
            if start.startswith(mark):
                return encoding
        if len(start) > 3 and not any(start[1::2]):
            return "utf-16-le"
        file.seek(0)
        decoder = codecs.getincrementaldecoder("utf-8")()
        try:
            while piece := file.read(2**20):
                decoder.decode(piece)
        except UnicodeDecodeError:
            return FALLBACK
    return "utf-8"


def _iterate_lines(
    path: Path, encoding: str, comments: bool = False, garbled: list[int] | None = None
) -> Iterator[tuple[int, str]]:
    """Yield the lines of a file that are not blank, with their numbers from 1; comments begin with #.

    Bytes that are not text, from the boot of a board or a card that lost power, are omitted; their line numbers are
    added to `garbled`.
    """
    errors = "replace" if encoding == FALLBACK else "strict"  # some bytes of cp1252 are undefined
    with _readable(path), path.open(encoding=encoding, errors=errors) as file:
        for number, line in enumerate(file, 1):
            text = _GARBAGE.sub("", line).replace("\0", "")
            if garbled is not None and text != line:
                garbled.append(number)
            line = text.rstrip("\n")
            if line.strip() and (comments or not line.startswith("#")):
                yield number, line


def _split(lines: Iterator[tuple[int, str]], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the cells of each row with the number of its last line; quoted cells may span several lines."""
    number = 0

    def texts() -> Iterator[str]:
        nonlocal number
        for number, line in lines:  # noqa: B007  the number is yielded below
            line = _MONITOR.sub(rf"\1{separator}", line)
            yield " ".join(line.split()) if separator == " " else line

    for row in csv.reader(texts(), delimiter=separator):
        yield number, row


def _find_dialect(sample: list[tuple[int, str]]) -> _Dialect:
    comments = [(number, line.lstrip("# ")) for number, line in sample if line.startswith("#")]
    lines = [(number, line) for number, line in sample if not line.startswith("#")]
    separator, n_skipped = "", 0
    if lines and re.fullmatch(r"\W?sep=.\W*", lines[0][1]):  # Excel writes it, in quotes or not
        separator, n_skipped = lines[0][1].strip('"')[4], 1
    lines = lines[n_skipped:]
    candidates = {candidate: list(_split(iter(lines), candidate)) for candidate in separator or SEPARATORS}
    separator = max(candidates, key=lambda candidate: _n_values([row for _, row in candidates[candidate]]))
    rows = [(number, [cell.strip() for cell in row]) for number, row in candidates[separator]]
    # 1. Find the columns of values, and the first line with values only in them.
    width = _width([row for _, row in rows])
    table = [row for _, row in rows if len(row) == width]
    shares = [np.mean([_is_value(cell) for cell in cells if cell] or [True]) for cells in zip(*table, strict=True)]
    is_data = [len(row) == width and any(map(_is_number, row)) and _fits(row, shares) for _, row in rows]
    start = is_data.index(True) if any(is_data) else len(rows)
    first_line = rows[start][0] if start < len(rows) else (rows[-1][0] + 1 if rows else 1)
    # 2. Find the lines of names and units before it.
    above = [(number, text) for number, text in comments if number < first_line]
    header, names, units = _find_names(rows[:start], width, above, separator)
    unnamed = list(zip(*table, strict=True))[len(names) :]
    columns = list(zip(*[row for _, row in rows[start:] if len(row) == width], strict=True))
    measured = [_MEASURED.fullmatch(next(filter(None, cells), "")) for cells in columns]
    if not header and measured and all(match and match[1] for match in measured):
        names, unnamed = [match[1] for match in measured if match], []
    units = units or [(match and match[3]) or "" for match in measured]
    names += ["" if header and not any(cells) else str(len(names) + i) for i, cells in enumerate(unnamed, 1)]
    # 3. Find the format of numbers and dates.
    values = [match[2] for _, row in rows[start:] for cell in row if (match := _MEASURED.fullmatch(cell))]
    has_comma = any(re.fullmatch(r"[-+]?\d*,\d+", value) for value in values)
    has_point = any(re.fullmatch(r"[-+]?\d*\.\d+", value) for value in values)
    date_shares = [np.mean([bool(_DATE.fullmatch(cell)) for cell in cells]) for cells in columns]
    dates = frozenset(i for i, share in enumerate(date_shares) if share > 0.5)
    units = [*units, *[""] * (len(names) - len(units))]
    return _Dialect(separator, has_comma and not has_point, header, first_line, width, names, units, dates)


def _find_names(
    rows: list[tuple[int, list[str]]], width: int, comments: list[tuple[int, str]], separator: str
) -> tuple[int, list[str], list[str]]:
    """Return the number of the fullest line above the values, or else of the last comment, its names, and the units."""
    above = [(line, row) for line, row in rows if 2 * sum(map(bool, row)) >= width]
    while above and len(above[-1][1]) == width != len(above[0][1]):
        above.pop(0)
    if not above and comments:
        text = comments[-1][1]
        split = _split(iter(comments[-1:]), separator if separator in text else max(SEPARATORS, key=text.count))
        above = [(line, [cell.strip() for cell in row]) for line, row in split if len(row) == width]
    header, names = max(above, key=lambda item: sum(map(bool, item[1])), default=(0, []))
    units = above[-1][1] if above and above[-1][0] > header else []
    if names and _CLOCK.fullmatch(names[0]):
        names[0] = "received"  # the monitor stamped the header as well
    return header, list(names), units


def _n_values(rows: list[list[str]]) -> int:
    """Return the number of values in the rows of the most frequent width; 0 for a single column."""
    width = _width(rows)
    return sum(_is_number(cell) for row in rows if len(row) == width for cell in row) if width > 1 else 0


def _width(rows: list[list[str]]) -> int:
    """Return the most frequent number of cells in rows with numbers."""
    widths = Counter(len(row) for row in rows if any(map(_is_number, row))) or Counter(map(len, rows))
    return widths.most_common(1)[0][0] if widths else 0


def _fits(row: list[str], shares: Sequence[float]) -> bool:
    """Return whether the cells of a row are values, or empty, in all columns that mostly hold values."""
    return all(not cell or _is_value(cell) for cell, share in zip(row, shares, strict=True) if share > 0.5)


def _is_number(cell: str) -> bool:
    cell = cell.strip()
    try:
        float(cell.replace(",", "."))
    except ValueError:
        measured = _MEASURED.fullmatch(cell)
        if measured is not None and (measured[1] or measured[3]):
            return _is_number(measured[2])
        return bool(_THOUSANDS.fullmatch(cell))
    return "_" not in cell


def _is_value(cell: str) -> bool:
    word = cell.strip().lower()
    return word in MISSING or word in _TRUTH or word == "?" or _is_number(word) or bool(_DATE.fullmatch(cell.strip()))


def _parse(cell: str, dialect: _Dialect, column: int, may_be_unknown: bool) -> float | None:
    """Return the number in a cell, NaN if it is missing, None for anything else."""
    try:
        value = float(cell)
        if value - value == 0 and "_" not in cell and not (dialect.decimal_comma and "." in cell):
            return value  # the fast path of most cells
    except ValueError:
        pass
    word = cell.lower()
    if word in MISSING:
        return np.nan
    if word in _TRUTH:
        return _TRUTH[word]
    if word == "?" and may_be_unknown:
        return UNKNOWN
    if (measured := _MEASURED.fullmatch(cell)) and (measured[1] or measured[3]):
        if measured[3] not in (None, dialect.units[column]):
            return None  # another unit than that of the column
        return _parse(measured[2], dialect, column, may_be_unknown=False)
    if dialect.decimal_comma:
        cell = cell.replace(".", "").replace(",", ".")
    elif _THOUSANDS.fullmatch(cell) and (dialect.separator == "," or "." in cell):
        cell = cell.replace(",", "")
    elif dialect.separator != ",":
        cell = cell.replace(",", ".")
    try:
        return float(cell) if "_" not in cell else None
    except ValueError:
        return None


def _parse_dates(texts: list[str], what: str) -> Array:
    """Return dates as seconds since 1970, or times of day as seconds since midnight; shape (R,), NaN where missing."""
    texts = [text.replace(",", ".") for text in texts]
    clocks = [_CLOCK.fullmatch(text) for text in texts]
    if any(clocks):
        fields = [[float(text or 0) for text in clock.groups()] if clock else [np.nan] * 3 for clock in clocks]
        return np.array(fields) @ [3600.0, 60.0, 1.0]
    try:
        times = np.array([text.removesuffix("Z") or "NaT" for text in texts], "datetime64[ns]")
    except ValueError:  # not ISO 8601
        try:
            import pandas
        except ImportError as error:
            raise InputError(
                f"{what}: dates such as {texts[0]!r} need pandas: pip install 'padforge[formats]'"
            ) from error
        is_european = bool(re.match(r"\d{1,2}\.", texts[0]))
        series = pandas.Series(texts)
        dates = pandas.to_datetime(series, format="mixed", dayfirst=is_european, errors="coerce", utc=True)
        times = dates.dt.tz_localize(None).to_numpy("datetime64[ns]")
    seconds = times.astype(np.int64) / 1e9
    return np.where(np.isnat(times), np.nan, seconds)
