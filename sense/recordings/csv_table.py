"""Reading CSV files: a file that is none is one clear line."""

import csv
import io
from pathlib import Path

from design.common.errors import InputError
from design.common.files import read_bytes


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """The names in the header of a CSV, without spaces around them, and the cells of all further lines.

    Empty lines at the end are none.

    Raises:
        InputError: the file cannot be read, or is no CSV.
    """
    content = read_bytes(path)
    try:
        text = io.StringIO(content.decode("utf-8-sig"), newline="")
        header, *lines = list(csv.reader(text)) or [[]]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV file ({error})") from error
    while lines and not lines[-1]:
        lines.pop()
    return [name.strip() for name in header], lines
