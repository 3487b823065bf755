"""Which lost fibres hurt: the errors without every one and every two fibres, as a drawing that stands in a page."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape

from padforge.design.common.plotting import ALARM, INK

_CELL = 40
_MOST_NUMBERS = 16
"""With more fibres, cells are too small for numbers to be read on a phone."""
_EVERY = 5
"""So many cells are then between two numbers of fibres."""
_WIDEST = 1.7
"""The drawing is not stretched beyond this."""

Errors = Mapping[tuple[int, ...], float]


def loss_chart(errors: Errors, fibres: int) -> str:
    """An SVG of a triangle: on its diagonal the error without one fibre, below it without two; darker is worse.

    Args:
        errors: mean error, mm, of sets of one and of two lost fibres, by index, ascending, and of none if known.
        fibres: how many there are.
    """
    low, high = min(errors.values()), max(errors.values())
    size = 14 if fibres <= _MOST_NUMBERS else 3 * fibres // 2
    left, top = 2 * size, 6
    side = left + fibres * _CELL + size // 2
    height = top + fibres * _CELL + 4 * size
    shapes = [*_axes(fibres, size, left, top), *_scale(low, high, size, left, height)]
    for lost, error in errors.items():
        if lost:
            at = left + lost[0] * _CELL, top + lost[-1] * _CELL
            shapes += _cell(lost, error, (error - low) / ((high - low) or 1.0), at, fibres <= _MOST_NUMBERS)
    return (
        f'<svg viewBox="0 0 {side} {height}" style="max-width:{_WIDEST * side:.0f}px" role="img"'
        f' aria-label="{escape(_told(errors))}" font-family="system-ui, sans-serif" text-anchor="middle" fill="{INK}">'
        f"{''.join(shapes)}</svg>"
    )


def _cell(lost: Sequence[int], error: float, share: float, at: tuple[int, int], numbered: bool) -> Iterator[str]:
    x, y = at
    names = " and ".join(str(fibre + 1) for fibre in lost)
    yield (
        f'<rect x="{x + 1}" y="{y + 1}" width="{_CELL - 2}" height="{_CELL - 2}" rx="3" fill="{_shade(share)}">'
        f"<title>without {names}: {error:.2f} mm</title></rect>"
    )
    if numbered:
        bold = ' font-weight="700"' if len(lost) == 1 else ""
        colour = f' fill="{INK if share < 0.65 else "#ffffff"}" pointer-events="none"'
        text = f"{error:.2f}" if error < 10 else f"{error:.1f}"
        yield _text(text, x + _CELL / 2, y + _CELL / 2 + 5, 14, bold + colour)


def _axes(fibres: int, size: int, left: int, top: int) -> Iterator[str]:
    for fibre in range(fibres):
        if fibres <= _MOST_NUMBERS or (fibre + 1) % _EVERY == 0:
            middle = (fibre + 0.5) * _CELL
            yield _text(str(fibre + 1), left - 0.7 * size, top + middle + size / 3, size)
            yield _text(str(fibre + 1), left + middle, top + fibres * _CELL + 1.2 * size, size)


def _scale(low: float, high: float, size: int, left: int, height: int) -> Iterator[str]:
    """The colours from the least error to the greatest, in the lower left corner."""
    y = height - 1.4 * size
    yield _text(f"{low:.2f}", left + 1.3 * size, y + 0.9 * size, size)
    for step in range(5):
        x = left + (2.9 + 1.4 * step) * size
        yield f'<rect x="{x:.1f}" y="{y:.1f}" width="{1.4 * size:.1f}" height="{size}" fill="{_shade(step / 4)}"/>'
    yield _text(f"{high:.2f} mm", left + 10.3 * size, y + 0.9 * size, size, ' text-anchor="start"')


def _text(text: str, x: float, y: float, size: int, style: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}"{style}>{text}</text>'


def _shade(share: float) -> str:
    """White for 0, the colour of alarm for 1."""
    pale = 1 - (0.06 + 0.94 * share)
    return "#" + "".join(f"{round(part + pale * (255 - part)):02x}" for part in bytes.fromhex(ALARM[1:]))


def _told(errors: Errors) -> str:
    """What somebody who cannot see it is told."""
    worst = {count: max((lost for lost in errors if len(lost) == count), key=errors.__getitem__) for count in (1, 2)}
    told = (f"worst without {' and '.join(str(i + 1) for i in lost)}: {errors[lost]:.2f} mm" for lost in worst.values())
    return f"Error without one and without two fibres; {'; '.join(told)}."
