"""Less of what takes most of the time of a command, where nobody looks at it."""

import pytest


def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have figures saved with nothing drawn in them."""
    small_pictures(monkeypatch)
    monkeypatch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)


def small_pictures(monkeypatch: pytest.MonkeyPatch, pixels: int = 100) -> None:
    """Draw moulds, tracks and findings on few pixels: these take most of the time of their pictures."""
    monkeypatch.setattr("padforge.fabricate.outputs.pictures.PIXELS", pixels)


def compare_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare pads and contacts by few presses and small networks."""
    for name, value in (("SIDE", 10), ("N_TEST", 50), ("HIDDEN", 5)):
        monkeypatch.setattr(f"padforge.design.contact_comparison.{name}", value)
