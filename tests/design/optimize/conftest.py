"""Scores that cost less, of which no test of a search wants more."""

import pytest


@pytest.fixture(autouse=True)
def little(little_scored: None) -> None:
    """For all tests here."""
