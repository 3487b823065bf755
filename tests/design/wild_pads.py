from typing import Literal

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from padforge.design import Contact, Morphology
from padforge.design.morphology import assemble_knots

Array = NDArray[np.float64]
KINDS = ("random", "steps", "lattice", "border", "alike", "edge", "needles", "level")
Length = Literal["manhattan", "euclidean"]
LENGTHS: tuple[Length, ...] = ("manhattan", "euclidean")
WEIGHTS: tuple[Literal["uniform", "inverse_square", "inverse"], ...] = ("uniform", "inverse_square", "inverse")
SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def wild_pads(draw: st.DrawFn, grids: tuple[int, int] = (1, 3), knots: tuple[int, int] = (0, 8)) -> Morphology:
    """Pads with steps and needles, fibres on the border, on each other, on knots of others."""
    grid, count = draw(st.integers(*grids)), draw(st.integers(*knots))
    rng, pitch = np.random.default_rng(draw(SEEDS)), draw(st.sampled_from([11.25, 0.1, 4.0, 1000.0]))
    return Morphology(wild_knots(draw(st.sampled_from(KINDS)), grid, count, rng), pitch)


def wild_knots(kind: str, grid: int, count: int, rng: np.random.Generator) -> Array:
    """Knots (2M, N+2, 2) of a kind of wildness."""
    inner = rng.uniform(0, grid + 1, (2 * grid, count, 2))
    if kind == "steps":  # knots of one travel coordinate are put next to each other
        inner[:grid, :, 0], inner[grid:, :, 1] = rng.uniform(0, grid + 1, 2)
    elif kind == "lattice":
        inner = np.round(2 * inner) / 2
    elif kind == "border":
        inner[:grid, :, 1] = rng.choice([0, grid + 1.0], (grid, count))
        inner[grid:, :, 0] = rng.choice([0, grid + 1.0], (grid, count))
    elif kind == "alike":  # the fibres of a family run on each other
        inner[:grid], inner[grid:] = inner[0], inner[grid]
    elif kind == "edge":
        inner = rng.choice([0.0, 1e-9, grid + 1.0], inner.shape)
    elif kind == "needles":
        inner[:grid, :, 0] = inner[:1, :1, 0] + 1e-9 * np.arange(count)
        inner[grid:, :, 1] = inner[:1, :1, 1] + 1e-9 * np.arange(count)
    elif kind == "level":
        inner[:grid, :, 1] = np.arange(1, grid + 1)[:, None] + rng.normal(0, 1e-12, (grid, count))
        inner[grid:, :, 0] = np.arange(1, grid + 1)[:, None]
    return assemble_knots(inner.clip(0, grid + 1))


wild_contacts = st.builds(
    Contact,
    radius=st.sampled_from([1e-9, 1e-6, 0.1, 0.6, 1.0, 7.0, 1e4]),
    sides=st.sampled_from([None, 3, 4, 5, 30, 512]),
    weight=st.sampled_from(WEIGHTS),
    length=st.sampled_from(LENGTHS),
)


def wild_presses(pad: Morphology, seed: int, count: int = 8) -> Array:
    """Presses (Q, 2) on knots and levels, a radius beside knots, outside of the pad and far away."""
    rng, knots = np.random.default_rng(seed), pad.knots.reshape(-1, 2)
    anywhere = rng.uniform(-1, pad.grid + 2, (count, 2))
    on_knots = rng.choice(knots, count)
    beside = rng.choice(knots, count) + rng.choice([0, 0.6, -0.6], (count, 2))
    far = rng.choice([-9e5, 9e5, 0, 1e-300], (count, 2))
    kinds = np.stack([anywhere, anywhere, on_knots, np.round(anywhere), beside, far])
    return kinds[rng.integers(len(kinds), size=count), np.arange(count)]


def longest_signals(pad: Morphology, length: Length) -> Array:
    """(2M,) the longest a signal can be with weight 1."""
    if length == "manhattan":
        return np.abs(np.diff(pad.knots, axis=1)).sum(axis=(1, 2))
    steps = np.diff(pad.knots, axis=1)
    across = np.concatenate([steps[: pad.grid, :, 1], steps[pad.grid :, :, 0]])
    return np.linalg.norm(steps, axis=2).sum(axis=1) + np.abs(across).sum(axis=1) + pad.grid + 1
