"""Fixtures shared by all tests."""

from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("padforge", deadline=None, derandomize=True)
settings.register_profile("stress", deadline=None, max_examples=1000, print_blob=True)
settings.load_profile("padforge")

PUBLISHED = Path(__file__).resolve().parents[2] / "shared" / "data" / "published"


@pytest.fixture(scope="session")
def published() -> Path:
    """Folder of the published study's files; tests that need it skip where it is absent."""
    if not PUBLISHED.is_dir():
        pytest.skip("the published data are not here")
    return PUBLISHED
