"""How much is tried: little every day, as much as the profile says under `--hypothesis-profile=stress`."""

import hypothesis
import pytest


def few(examples: int) -> hypothesis.settings:
    """Settings of a test that tries `examples` cases in everyday runs, and as many as the profile says under stress."""
    default = hypothesis.settings.default
    assert default is not None
    stressed = default.max_examples >= hypothesis.settings.get_profile("stress").max_examples
    return hypothesis.settings(max_examples=default.max_examples if stressed else examples)


LONG = pytest.mark.skipif(few(1).max_examples == 1, reason="takes long; --hypothesis-profile=stress runs it")
"""Marks what ordinary days go without: cases of a kind that is tried on a smaller one as well."""
