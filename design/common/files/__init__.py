"""Files as every stage writes and reads them: atomic, together or not at all, self-describing JSON."""

from .blame import as_written, refuse_unwritable, writing
from .dependents import check_replaceable, find_dependents
from .folders import claimed, resolve_exchange, settle, staged
from .litter import UNFINISHED, clear_litter, scratch, unfinished_file
from .locks import held, lock
from .reading import MOST_BYTES, provenance, read_bytes, read_json, require_file, sha256, unchanged
from .single_files import atomic, open_in_place, sync, to_disk, write_json, write_text

__all__ = [
    "MOST_BYTES",
    "UNFINISHED",
    "as_written",
    "atomic",
    "check_replaceable",
    "claimed",
    "clear_litter",
    "find_dependents",
    "held",
    "lock",
    "open_in_place",
    "provenance",
    "read_bytes",
    "read_json",
    "refuse_unwritable",
    "require_file",
    "resolve_exchange",
    "scratch",
    "settle",
    "sha256",
    "staged",
    "sync",
    "to_disk",
    "unchanged",
    "unfinished_file",
    "write_json",
    "write_text",
    "writing",
]
