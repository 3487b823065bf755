"""Pairs of contacts: ways to learn where two are, when neither is the first of them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from padforge.sense.recordings.processing.limits import Array

LABELLED = "fixed labels"


@dataclass(frozen=True)
class Way:
    """How networks are taught pairs of contacts.

    Attributes:
        targets: from places (Q, 2, 2) of two contacts each, (A, Q, O) that are equally right.
        pairs: places (T, 2, 2) from what S networks give, (S, T, O).
    """

    targets: Callable[[Array], Array]
    pairs: Callable[[Array], Array]


def by_x(places: Array) -> Array:
    """Pairs (Q, 2, 2) with the contact of lower x first."""
    return np.take_along_axis(places, places[:, :, :1].argsort(axis=1), axis=1)


def both_orders(places: Array) -> Array:
    """(2, Q, 4): ordered by x, since networks learn better from an order that lasts than from one at random, and
    the other way round."""
    return np.stack([_flat(by_x(places)), _flat(by_x(places)[:, ::-1])])


def moments(places: Array) -> Array:
    """(Q, 5) of pairs (Q, 2, 2), the same in either order: their midpoint, and xx, xy, yy of half their difference."""
    half = (places[:, 0] - places[:, 1]) / 2
    return np.column_stack([places.mean(axis=1), half[:, 0] ** 2, half[:, 0] * half[:, 1], half[:, 1] ** 2])


def pairs_of_moments(found: Array) -> Array:
    """(T, 2, 2) pairs whose `moments` (T, 5) are the nearest: along the main axis, at either side of the midpoint."""
    squares, axes = np.linalg.eigh(found[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
    half = np.sqrt(np.maximum(squares[:, 1:], 0)) * axes[:, :, 1]
    return found[:, None, :2] + np.stack([half, -half], axis=1)


def mean_of_unordered(found: Array) -> Array:
    """(T, 2, 2) mean of pairs that networks name in an order of their own, (S, T, 4): each turned as the first is."""
    named = found.reshape(*found.shape[:2], 2, 2)
    off, off_turned = (np.square(pairs - named[0]).sum(axis=(2, 3)) for pairs in (named, named[:, :, ::-1]))
    return np.where((off <= off_turned)[:, :, None, None], named, named[:, :, ::-1]).mean(axis=0)


def unordered_distances(found: Array, pressed: Array) -> Array:
    """(T,) mean distance of two contacts found to those pressed, both (T, 2, 2), in the order that makes it less."""
    off = np.linalg.norm(found[:, :, None] - pressed[:, None], axis=3)
    return np.minimum(off[:, 0, 0] + off[:, 1, 1], off[:, 0, 1] + off[:, 1, 0]) / 2


def _flat(places: Array) -> Array:
    return places.reshape(-1, 4)


def _mean(found: Array) -> Array:
    return found.mean(axis=0).reshape(-1, 2, 2)


WAYS = {
    LABELLED: Way(lambda places: _flat(places)[None], _mean),
    "sorted": Way(lambda places: _flat(by_x(places))[None], _mean),
    "free": Way(both_orders, mean_of_unordered),
    "moments": Way(lambda places: moments(places)[None], lambda found: pairs_of_moments(found.mean(axis=0))),
}
"""As published, in the order drawn; by x; with a loss that does not care for the order; by what has no order."""


def learnt(
    way: Way, given: Array, places: Array, rng: np.random.Generator, members: int, hidden: int, epochs: int
) -> Callable[[Array], Array]:
    """What finds pairs (T, 2, 2) from signals (T, D), having learnt from signals (Q, D) of pairs (Q, 2, 2)."""
    from padforge.design.networks import fit_batch

    targets = way.targets(places)
    networks = fit_batch(given, targets[0], rng.spawn(members), hidden, epochs, alternatives=targets[1:])
    return lambda signalled: way.pairs(np.stack([network(signalled) for network in networks]))
