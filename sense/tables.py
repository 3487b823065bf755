"""Reading CSV files: a file that is none is one clear line."""

import csv
from pathlib import Path

from design.errors import InputError


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """The names in the header of a CSV, without spaces around them, and the cells of all further lines.

    Empty lines at the end are none.

    Raises:
        InputError: the file cannot be read, or is no CSV.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *lines = list(csv.reader(file)) or [[]]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV file ({error})") from error
    while lines and not lines[-1]:
        lines.pop()
    return [name.strip() for name in header], lines
