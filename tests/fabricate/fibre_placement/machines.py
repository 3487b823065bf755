"""A machine that does what G-code says, and the fibres as the needle should place them."""

import math
import re
from dataclasses import dataclass, field

import numpy as np
import shapely
from scipy.spatial import KDTree

from padforge.design.morphology import Array
from padforge.fabricate.plan import Plan
from tests.fabricate.planted import exact_fibre

G_CODE = re.compile(r"([A-Z])([-+]?\d+(?:\.\d+)?)")


@dataclass
class Way:
    """What a machine did between two pauses: corners (n, 3) mm, speeds (n - 1,) mm/s, and whether it was laying."""

    corners: Array
    speeds: Array
    lays: list[bool]


@dataclass
class Run:
    """What a program made a machine do: ways, and before each of them what it asked for."""

    ways: list[Way] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def end_way(self, corners: Array, speeds: list[float], lays: list[bool]) -> None:
        """Keep the way since the last pause; before the first there is none."""
        if self.asked:
            self.ways.append(Way(corners, np.array(speeds), lays))

    def placed_fibres(self) -> list[tuple[int, Way]]:
        """The fibres, 0.., that were placed, in that order."""
        fibres = []
        for message, way in zip(self.asked, self.ways, strict=True):
            if "fasten" in message:
                fibres.append((int(message.split()[1].strip(",:")) - 1, way))
                assert all(way.lays)
            else:
                assert not any(way.lays)
        return fibres


def run_gcode(text: str) -> Run:
    """G1, G21, G90 and M0 as the standard has them, modal; anything else is refused, as G0, which heeds no speed."""
    run, corners, speeds, lays = Run(), [], [], []
    highest = -math.inf
    at: dict[str, float] = {}
    speed = math.nan
    for line in text.splitlines():
        comment = "".join(re.findall(r"\(([^()]*)\)", line))
        words = G_CODE.findall(re.sub(r"\([^()]*\)", "", line.partition(";")[0]))
        assert "".join(letter + number for letter, number in words) == re.sub(
            r"\([^()]*\)|\s", "", line.partition(";")[0]
        )
        target = dict(at)
        for letter, number in words:
            match letter + number:
                case "G1" | "G21" | "G90":
                    pass
                case "M0":
                    run.end_way(np.array(corners), speeds, lays)
                    run.asked.append(comment)
                    corners, speeds, lays = corners[-1:], [], []
                case _ if letter == "F":
                    speed = float(number) / 60
                case _:
                    assert letter in "XYZ"
                    target[letter] = float(number)
        if target != at:
            level, at = at.get("Z") == target.get("Z"), target
            highest = max(highest, at["Z"])
            if {"X", "Y"} <= at.keys():
                speeds += [speed] if corners else []
                lays += [level and at["Z"] < highest] if corners else []
                corners.append([at["X"], at["Y"], at["Z"]])
    run.end_way(np.array(corners), speeds, lays)
    return run


def exact_path(plan: Plan, fibre: int) -> Array:
    """(n, 2) a fibre from lead to lead by scipy's PCHIP, on the pad turned over, from its middle."""
    mould, line = plan.settings.mould, exact_fibre(plan.pad, fibre)
    ends = line[[0, -1]]
    ends[:, plan.family(fibre)] += np.array([-1, 1]) * (mould.border_mm + mould.exit_mm + mould.lead_mm)
    return np.vstack([ends[:1], line, ends[1:]]) * (-1, 1)


def max_distance(one: Array, other: Array, points: int) -> float:
    """How far `points` places of either polyline (n, 2) lie at most from the other one, mm, to a micrometre."""
    dense = [shapely.get_coordinates(shapely.segmentize(shapely.LineString(line), 0.004)) for line in (one, other)]
    looked_at = [line[np.linspace(0, len(line) - 1, points).astype(int)] for line in dense]
    return max(float(KDTree(dense[1 - i]).query(looked_at[i])[0].max()) for i in (0, 1))
