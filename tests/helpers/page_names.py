"""What the script of a page reads of the view that it is sent: the two sides of it are written in two languages."""

import re

from padforge.common.server import page_text


def names_in_view(page: str) -> set[str]:
    """Names of the values that a page of sense reads."""
    text = page_text("padforge.sense.live", f"pages/{page}", "pages/common.css", "pages/common.js")
    return set(re.findall(r"\bview\.(\w+)", text))
