"""Signals of a layer against fibres that its displacements carry along: outside the kernels, in three dimensions."""

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from padforge.design import Contact, Morphology, signals
from padforge.design.contact import grid_positions
from padforge.design.layer import solve_press
from padforge.design.settings import Layout

AMPLITUDE = 1e-6  # share of the displacements by which points are carried, so that lengths change in proportion
TOOLS = ("dome", "ball", "flat", "finger")


def random_press(seed):
    """A pad of few fibres, positions, and a press of any tool into any layer."""
    rng, tool = np.random.default_rng(seed), TOOLS[seed % 4]
    layout = Layout.create((int(rng.integers(0, 3)), int(rng.integers(1, 3))), float(rng.uniform(4, 15)))
    thickness_mm, radius_mm = float(rng.uniform(2, 12)), float(rng.uniform(2.5, 12))
    depth_mm = float(rng.uniform(0.1, 0.8) * thickness_mm)
    if tool == "ball":
        depth_mm = min(depth_mm, 0.6 * radius_mm)
    # the strains of an ideal rod are infinite at its rim; nearer below it a fibre feels how sharp a real one is
    shallowest_mm = 1.0 if tool == "flat" else 0.25
    depths_mm = tuple(rng.uniform(shallowest_mm, 0.9 * thickness_mm, 2).tolist())
    lengths: dict[str, Any] = {"tool_radius_mm": radius_mm, "depth_mm": depth_mm, "thickness_mm": thickness_mm}
    base = "slipping" if seed // 4 % 2 else "bonded"
    contact = Contact(tool=tool, base=base, fibre_depths_mm=depths_mm, **lengths)
    pad = Morphology.random(layout, int(rng.integers(0, 6)), rng)
    return pad, rng.uniform(0, layout.extent, (4, 2)), contact


def displacement(press, height_mm, end_mm):
    """Outward displacement, and how much nearer two points above and below each other come; functions of r.

    Both from the vertical strain alone: silicone that is pressed flat goes outward, u r = int -eps_zz r dr.
    """
    a = press.contact_radius_mm
    near, edge = np.linspace(0, a + 1.5, 160), np.linspace(max(a - 1, 0), a + 1, 81)
    r = np.unique(np.concatenate([near, edge, np.geomspace(a + 1.5, max(end_mm, a + 2), 90)]))
    strain = CubicSpline(r, press.strains(r, height_mm).compressive)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    at = r[:-1, None] + np.diff(r)[:, None] * (1 + nodes) / 2
    flow = np.cumsum((at * strain(at)) @ (weights / 2) * np.diff(r))
    return CubicSpline(r, np.append(0, flow / r[1:])), strain


def carried_lengths(pad, presses, contact):
    """Change of length of each fibre (Q, F) carried along, and of pairs of points above and below it; grid units."""
    press = solve_press(contact.tool, contact.tool_radius_mm, contact.depth_mm, contact.thickness_mm, contact.base)
    out = np.zeros((len(presses), pad.layout.fibres))
    heights_mm, end_mm = contact.thickness_mm - np.array(contact.fibre_depths_mm), 1.1 * np.hypot(*pad.layout.size_mm)
    fields = [displacement(press, height_mm, end_mm) for height_mm in heights_mm.tolist()]
    for f, knots in enumerate(pad.knots):
        axis = pad.layout.family(f)
        curve = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])
        t = np.linspace(knots[0, axis], knots[-1, axis], 800)
        arc = np.append(0, np.cumsum(np.hypot(np.diff(t), np.diff(curve(t)))))
        t = np.interp(np.linspace(0, arc[-1], 2400), arc, t)
        points = pad.unit_mm * np.stack([t, curve(t)][:: 1 - 2 * axis], axis=1)
        outward, flattening = fields[axis]
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        for q, centre in enumerate(pad.unit_mm * presses):
            way = points - centre
            r = np.linalg.norm(way, axis=1)
            moved = points + AMPLITUDE * way * (outward(r) / np.maximum(r, 1e-9))[:, None]
            longer = (np.linalg.norm(np.diff(moved, axis=0), axis=1) - lengths).sum() / AMPLITUDE
            flatter = (flattening((r[1:] + r[:-1]) / 2) * lengths).sum()
            out[q, f] = (contact.stretch * longer + contact.squeeze * flatter) / pad.unit_mm
    return out


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 10), marks=pytest.mark.slow)], ids=str)
def test_layer_signals_are_those_of_carried_fibres(seeds):
    for seed in seeds:
        pad, presses, contact = random_press(seed)
        straight = signals(Morphology.straight(pad.layout), grid_positions(((0, 0), pad.layout.extent), 15), contact)
        error = np.abs(signals(pad, presses, contact) - carried_lengths(pad, presses, contact)).max()
        assert error < 0.01 * np.abs(straight).max(), (seed, contact)
