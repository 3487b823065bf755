import pytest


def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have figures saved with nothing drawn in them."""
    small_pictures(monkeypatch)
    monkeypatch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)


def small_pictures(monkeypatch: pytest.MonkeyPatch, pixels: int = 100) -> None:
    """Draw moulds, tracks and findings on few pixels: these take most of the time of their pictures."""
    monkeypatch.setattr("padforge.fabricate.outputs.pictures.PIXELS", pixels)


def compare_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare pads and contacts by few presses."""
    for name, value in (("PRESSES", 256), ("MIN_PRESSES", 8)):
        monkeypatch.setattr(f"padforge.design.objectives.bayes_error.{name}", value)
