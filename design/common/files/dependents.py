"""What was made from a file, as documents say of their inputs: a file that others stand on is not replaced unasked."""

import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from padforge.design.common.errors import InputError

from .reading import read_bytes, sha256

_MORPHOLOGY = "padforge-morphology/"
"""How the format of a pad begins: one that was made from another pad is a pad of its own."""


def find_dependents(path: Path, remade: Collection[str] = ()) -> list[str]:
    """Return the names of documents and recordings beside a file that were made from it, or from such a one.

    Args:
        path: the file.
        remade: names of those that come with the file that takes its place.
    """
    documents = {name: document for name, document in _documents(path.parent) if path.parent / name != path}
    sources, dependents = [path], []
    for source in sources:
        about = _about(source)
        for name in [name for name, document in documents.items() if _is_made_from(document, source.name, *about)]:
            del documents[name]
            dependents.append(name)
            sources.append(path.parent / name)
    return sorted({*dependents} - {*remade})


def check_replaceable(
    path: Path, by: Path | Mapping[str, Any], remade: Collection[str] = (), force: bool = False
) -> None:
    """Refuse to replace a file that others beside it were made from, unless it stays as it is.

    Args:
        path: the file, which need not be there.
        by: the file that takes its place; before there is one, what is known of its provenance.
        remade: see `find_dependents`.
        force: whether it is replaced all the same.

    Raises:
        InputError: naming what was made from it.
    """
    if force or not path.is_file():
        return
    if isinstance(by, Path):
        stays = sha256(by) == sha256(path)
    else:
        before = _provenance(_document(path))
        stays = all(before.get(key) == value for key, value in json.loads(json.dumps(by)).items())
    if not stays and (dependents := find_dependents(path, remade)):
        *names, last = dependents
        listed = f"{', '.join(names)} and {last} were" if names else f"{last} was"
        raise InputError(f"{path}: {listed} made from it; choose another --out, or replace it with --force")


def _documents(folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the documents of stages in a folder by name, those of recordings by the name of their folder."""
    for path in sorted([*folder.glob("[!.]*.json"), *folder.glob("[!.]*/start.json")]):
        document = _document(path)
        if not str(document.get("format")).startswith(_MORPHOLOGY):
            yield path.name if path.parent == folder else path.parent.name, document


def _document(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one where there is none, since whatever lies in a folder is looked at."""
    try:
        document = json.loads(read_bytes(path))
    except (InputError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _provenance(document: Mapping[str, Any]) -> Mapping[str, Any]:
    made_by = document.get("provenance")
    return made_by if isinstance(made_by, dict) else {}


def _about(source: Path) -> tuple[str | None, Mapping[str, Any]]:
    """Return the digest of a file and its provenance; of a recording neither, as documents have other digests of it."""
    return (None, {}) if source.is_dir() else (sha256(source), _provenance(_document(source)))


def _is_made_from(document: Mapping[str, Any], name: str, digest: str | None, made_by: Mapping[str, Any]) -> bool:
    """Whether a document says that it was made from a file with this digest, or from a model of this provenance."""
    inputs = _provenance(document).get("inputs")
    inputs = inputs if isinstance(inputs, dict) else {}
    if digest is None:
        return name in inputs
    if name == "morphology.json" and document.get("morphology_sha256") == digest:
        return True
    return inputs.get(name) == digest or (bool(made_by) and inputs.get(Path(name).stem) == made_by)
