"""What lies in a folder."""

from pathlib import Path


def files_in(folder: str | Path) -> dict[str, bytes]:
    """The content of the files of a folder and of the folders in it, by their paths there."""
    paths = (path for path in Path(folder).rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
