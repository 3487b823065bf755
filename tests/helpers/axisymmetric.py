"""Finite elements of an incompressible elastic layer under a tool: the oracle of `padforge.design.layer`.

Taylor-Hood elements on a grid of rectangles, biquadratic displacements and bilinear pressure (Hughes 2000, The Finite
Element Method, ch. 4), axisymmetric; the contact is an active set of nodes. Nothing is shared with the Hankel solution.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu


class Pressed(NamedTuple):
    r: np.ndarray
    z: np.ndarray
    outward: np.ndarray
    down: np.ndarray
    contact_radius: float  # of the outermost node that touches the tool
    force: float


def shapes(order, x):
    """Values and slopes of the Lagrange polynomials of an interval [-1, 1] at points; both (points, order + 1)."""
    if order == 1:
        return np.stack([(1 - x) / 2, (1 + x) / 2], 1), np.tile([-0.5, 0.5], (len(x), 1))
    values = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2], 1)
    return values, np.stack([x - 0.5, -2 * x, x + 0.5], 1)


def press(tool_depth, r_edges, z_edges, bonded):
    """Press a layer of G = 1 down to tool_depth(r) where the tool touches it, without friction.

    Args:
        tool_depth: depth of the tool's surface below the undeformed face, of distances (n,).
        r_edges, z_edges: edges of the elements, from 0.
        bonded: whether the base holds the layer, or it slips there.
    """
    r = np.sort(np.append(r_edges, (r_edges[1:] + r_edges[:-1]) / 2))
    z = np.sort(np.append(z_edges, (z_edges[1:] + z_edges[:-1]) / 2))
    nodes, corners = len(r) * len(z), len(r_edges) * len(z_edges)
    gauss, weights = np.polynomial.legendre.leggauss(3)
    x, y = (v.ravel() for v in np.meshgrid(gauss, gauss, indexing="ij"))
    weight = np.outer(weights, weights).ravel()
    rows, columns, entries = [], [], []
    (nx, dx), (ny, dy), (px, _), (py, _) = shapes(2, x), shapes(2, y), shapes(1, x), shapes(1, y)
    value, pressure = (np.einsum("qi,qj->qij", a, b).reshape(9, -1) for a, b in ((nx, ny), (px, py)))
    by_x, by_y = (np.einsum("qi,qj->qij", a, b).reshape(9, -1) for a, b in ((dx, ny), (nx, dy)))
    for i, j in product(range(len(r_edges) - 1), range(len(z_edges) - 1)):
        width, height = r_edges[i + 1] - r_edges[i], z_edges[j + 1] - z_edges[j]
        radius = r_edges[i] + width * (1 + x) / 2
        volume = weight * width * height / 4 * radius
        by_r, by_z, over_r, zero = by_x * 2 / width, by_y * 2 / height, value / radius[:, None], np.zeros_like(value)
        # strains rr, hoop, zz and shear / sqrt 2 of unknowns (outward, up); energy is G times their squares
        pairs = (by_r, zero), (over_r, zero), (zero, by_z), (by_z / 2**0.5, by_r / 2**0.5)
        strain = np.stack([np.hstack(pair) for pair in pairs])
        stiffness = 2 * np.einsum("q,cqa,cqb->ab", volume, strain, strain)
        divergence = np.einsum("q,qa,qb->ab", volume, pressure, strain[:3].sum(axis=0))
        local = np.block([[stiffness, divergence.T], [divergence, np.zeros((4, 4))]])
        node = ((2 * i + np.arange(3))[:, None] * len(z) + 2 * j + np.arange(3)).ravel()
        corner = ((i + np.arange(2))[:, None] * len(z_edges) + j + np.arange(2)).ravel()
        unknown = np.concatenate([node, nodes + node, 2 * nodes + corner])
        rows.append(np.repeat(unknown, len(unknown)))
        columns.append(np.tile(unknown, len(unknown)))
        entries.append(local.ravel())
    count = 2 * nodes + corners
    matrix = sparse.csc_matrix((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), (count,) * 2)
    index = np.arange(nodes).reshape(len(r), len(z))
    held = [index[0], nodes + index[:, 0], *([index[:, 0]] if bonded else [])]  # the axis and the base
    face = nodes + index[:, -1]
    target = tool_depth(r)
    touching = (target > 0) & (r < r[-1])
    for _ in range(60):
        solution = np.zeros(count)
        solution[face[touching]] = -target[touching]
        fixed = np.concatenate([*held, face[touching]])
        free = np.setdiff1d(np.arange(count), fixed)
        solution[free] = splu(matrix[free][:, free]).solve(-(matrix[free] @ solution))
        reaction = matrix[face] @ solution
        # nodes that the tool would have to pull are let go, nodes that it would enter are taken
        now = np.where(touching, reaction < 0, -solution[face] < target)
        if (now == touching).all():
            break
        touching = now
    else:
        raise AssertionError("the contact does not settle")
    up = solution[nodes : 2 * nodes].reshape(len(r), len(z))
    force = -2 * np.pi * reaction[touching].sum()
    return Pressed(r, z, solution[:nodes].reshape(len(r), len(z)), -up, r[touching].max(), force)
