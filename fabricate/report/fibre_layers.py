"""The fibres of a pad by the depth they lie at, in the order and the colours in which every drawing has them."""

from dataclasses import dataclass

from padforge.design.common.plotting import HORIZONTAL, VERTICAL
from padforge.fabricate.mould.plan import Plan

FAMILIES = ("horizontal", "vertical")
COLOURS = (HORIZONTAL, VERTICAL)

_PALEST = 0.7
"""Limit of the white in a family's palest tint; more would be lost on paper."""


@dataclass(frozen=True)
class Layer:
    """The fibres of one depth, all of one family.

    Attributes:
        family: 0 horizontal, 1 vertical. level: as in `Plan.levels`.
        depth_mm: of their tracks in the casting.
        fibres: their numbers among all, 0..F-1.
        colour: "#rrggbb", the family's own for its deepest level and paler the shallower.
    """

    family: int
    level: int
    depth_mm: float
    fibres: tuple[int, ...]
    colour: str

    @property
    def name(self) -> str:
        """Its id in a drawing, such as "horizontal-1.2"."""
        return f"{FAMILIES[self.family]}-{self.depth_mm:g}"


def layers(plan: Plan) -> list[Layer]:
    """The levels of a plan in laying order, the deepest first."""
    laid = [
        tuple(fibre for fibre, own in enumerate(plan.levels) if own == level) for level in range(len(plan.heights_mm))
    ]
    families = [plan.family(fibres[0]) for fibres in laid]
    found = []
    for level, (family, depth_mm, fibres) in enumerate(zip(families, plan.depths_mm, laid, strict=True)):
        white = _PALEST * families[level + 1 :].count(family) / families.count(family)
        found.append(Layer(family, level, depth_mm, fibres, pale(COLOURS[family], white)))
    return found[::-1]


def fibre_name(plan: Plan, fibre: int) -> str:
    """What a fibre is called, such as "horizontal 1"; each family counts from 1."""
    return f"{FAMILIES[plan.family(fibre)]} {fibre - plan.pad.layout.families[plan.family(fibre)].start + 1}"


def pale(colour: str, white: float) -> str:
    """A colour "#rrggbb" mixed with a share of white."""
    return "#" + "".join(f"{round(part + white * (255 - part)):02x}" for part in bytes.fromhex(colour[1:]))
