"""Pictures where nobody looks at them."""

import pytest


def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have figures saved with nothing drawn in them: drawing takes most of the time of many a command."""
    monkeypatch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)
