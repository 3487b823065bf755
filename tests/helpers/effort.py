"""How many cases a test tries."""

import hypothesis


def few(examples: int) -> hypothesis.settings:
    """Settings of a test that tries so many cases."""
    return hypothesis.settings(max_examples=examples)
