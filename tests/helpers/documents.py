import json
import re
from typing import Any

LEAF = re.compile(r"[\[{]\s+([^\[\]{}]*?)\s+[\]}]")


def document_text(document: Any) -> str:
    """JSON with a line for each row of numbers or of names and values."""
    text = json.dumps(document, indent=1, ensure_ascii=False)

    def on_one_line(match: re.Match[str]) -> str:
        return match[0][0] + re.sub(r"\s*\n\s*", " ", match[1]) + match[0][-1]

    return LEAF.sub(on_one_line, text)
