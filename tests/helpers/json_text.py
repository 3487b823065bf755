"""JSON as a reviewer reads it: what belongs together on one line."""

import json
from typing import Any

MAX_VALUES = 12  # on a line


def json_text(document: Any, indent: str = "") -> str:
    """JSON with a line for each list or object of at most `MAX_VALUES` values, and a line a member of longer ones.

    Lines break by the numbers of values alone, so that no digit more or less moves one.
    """
    parts = list(document.values() if isinstance(document, dict) else document if isinstance(document, list) else [])
    if _size(document) <= MAX_VALUES:
        return json.dumps(document, ensure_ascii=False)
    names = [f"{json.dumps(name)}: " for name in document] if isinstance(document, dict) else [""] * len(parts)
    lines = [f"{indent} {name}{json_text(part, indent + ' ')}" for name, part in zip(names, parts, strict=True)]
    begin, end = "{}" if isinstance(document, dict) else "[]"
    return f"{begin}\n" + ",\n".join(lines) + f"\n{indent}{end}"


def _size(document: Any) -> int:
    if isinstance(document, dict | list):
        return sum(map(_size, document.values() if isinstance(document, dict) else document))
    return 1
