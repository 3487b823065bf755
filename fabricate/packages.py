"""What a 3MF is made of, looked at before anything in it is unpacked or built: a few bytes can stand for very much."""

import zipfile
from functools import cache
from pathlib import Path
from xml.parsers import expat

MOST_BYTES = 2**27
"""Unpacked; a model of a million triangles takes half of it."""

MOST_COPIES = 1000
"""Objects that are built, each counted as often as it is used."""

MOST_DEPTH = 16
"""Objects within objects within objects."""


def refuse_swollen(path: Path) -> None:
    """Refuse a 3MF that unpacks to too much, or whose objects are made of too many objects, or of themselves.

    Raises:
        ValueError: says what there is too much of. zipfile.BadZipFile, expat.ExpatError: no such file.
    """
    built: list[str] = []
    parts: dict[str, list[str]] = {}
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MOST_BYTES:
            raise ValueError(f"it unpacks to {size} bytes, allowed are {MOST_BYTES}")
        for name in archive.namelist():
            if name.lower().endswith(".model"):
                _read_parts(archive.read(name), built, parts)

    @cache
    def copies(name: str, depth: int) -> int:
        if depth > MOST_DEPTH:
            raise ValueError(f"its objects are made of others more than {MOST_DEPTH} deep, or of themselves")
        return 1 + sum(copies(part, depth + 1) for part in parts.get(name, []))

    count = sum(copies(name, 0) for name in built)
    if count > MOST_COPIES:
        raise ValueError(f"it is built of {count} objects, allowed are {MOST_COPIES}")


def _read_parts(content: bytes, built: list[str], parts: dict[str, list[str]]) -> None:
    """Add the objects that a model builds, and those that each of its objects is made of."""
    within = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal within
        match tag.rpartition(":")[2]:
            case "object":
                within = attributes.get("id", "")
            case "component":
                parts.setdefault(within, []).append(attributes.get("objectid", ""))
            case "item":
                built.append(attributes.get("objectid", ""))

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.Parse(content, True)
