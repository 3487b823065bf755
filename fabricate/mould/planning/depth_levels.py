"""Depths at which fibres lie: crossing fibres never at one depth.

Every horizontal crosses every vertical, so the families need depths of their own; one each is enough as long as no
two fibres of a family cross. Where they do, each family takes as many as its crossings need, by graph colouring.
"""

from collections.abc import Iterable, Sequence

from padforge.design.paths.curves import Crossing


def fibre_levels(counts: tuple[int, int], clashes: Sequence[Crossing], deep_horizontal: bool) -> tuple[int, ...]:
    """(H + V,) level of every fibre, 0 the shallowest; the deep family has the upper ones.

    Args:
        counts: H and V.
        clashes: crossings of fibres of one family, in any order.
        deep_horizontal: whether horizontals are the deep family.
    """
    horizontal, vertical = range(counts[0]), range(counts[0], sum(counts))
    shallow, deep = (vertical, horizontal) if deep_horizontal else (horizontal, vertical)
    level = _coloured(shallow, clashes)
    below = 1 + max(level.values(), default=-1)
    level |= {fibre: below + colour for fibre, colour in _coloured(deep, clashes).items()}
    return tuple(level[fibre] for fibre in range(sum(counts)))


def _coloured(family: Iterable[int], clashes: Sequence[Crossing]) -> dict[int, int]:
    """A colour, 0.., for every fibre of a family, different for any two that cross."""
    colours = dict.fromkeys(family, 0)
    edges = {(c.first, c.second) for c in clashes if c.first in colours and c.second in colours}
    if edges:
        import networkx

        graph = networkx.Graph(sorted(edges))
        colours |= networkx.greedy_color(graph, strategy="DSATUR")
    return colours
