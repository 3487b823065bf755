"""What `padforge.sense.localizer.response.observer` computes, as nodes of an ONNX graph: from inputs to a place."""

import numpy as np
from numpy.typing import ArrayLike
from onnx import TensorProto

from padforge.sense.localizer.response.observer import BEFOREHAND, COMPONENTS, FARTHEST, LEAST_SPREAD, LOOKS, Observer

from padforge.sense.live.deployment.onnx_graph.features_graph import END, GraphNodes


def observed(g: GraphNodes, observer: Observer, inputs: str, alive: str) -> tuple[str, str]:
    """Places (Q, 2) and what is told of them (Q, `TOLD`), as `Observer.__call__`, of inputs that are 0 where lost."""
    fibres, size = len(observer.projection), COMPONENTS
    inputs, alive = (g("Cast", each, to=TensorProto.DOUBLE) for each in (inputs, alive))
    there = g("Unsqueeze", alive, g.constant([2]))
    by_fibre = g("MatMul", g("Transpose", inputs, perm=[1, 0, 2]), _number(g, observer.projection))
    seen = g("Transpose", by_fibre, perm=[1, 0, 2])
    mean, variance, both = _on_grid(g, observer, seen, there)
    known, place = g("Div", _number(g, BEFOREHAND), variance), mean
    spread, answers = variance, _number(g, observer.answers.reshape(len(observer.answers) ** 2, -1))
    for _ in range(LOOKS):
        found = _looked_up(g, answers, len(observer.answers), place)

        def per_fibre(begin: int, end: int, *shape: int, found: str = found) -> str:
            part = g.part(found, begin * fibres, end * fibres, axis=1)
            return g("Reshape", part, g.constant([-1, fibres, *shape]))

        off = g("Mul", there, g("Sub", seen, per_fibre(0, size, size)))
        slopes = g("Mul", per_fibre(size, 3 * size, 2, size), g("Unsqueeze", off, g.constant([2])))
        weighed = g("Mul", there, per_fibre(3 * size, 3 * size + 3, 3))
        curved = g("ReduceSum", weighed, g.constant([1]), keepdims=0)
        pull = g("ReduceSum", slopes, g.constant([1, 3]), keepdims=0)
        pull = g("Add", pull, g("Mul", known, g("Sub", mean, place)))
        spread, step = _solved(g, curved, known, pull)
        step = g("Clip", step, _number(g, -FARTHEST), _number(g, FARTHEST))
        within = g("Max", g("Add", place, step), _number(g, observer.bounds[0]))
        place = g("Min", within, _number(g, observer.bounds[1]))
    two = _number(g, 2)
    logs = (g("Add", _number(g, 1), g("Mul", _number(g, 0.25), g("Log", each))) for each in (spread, variance))
    of_place, of_mean = logs
    told = g("Concat", g("Mul", two, place), of_place, g("Mul", two, mean), of_mean, both, axis=1)
    place = g("Add", g("MatMul", place, _number(g, observer.turn.T)), _number(g, observer.shift))
    return g("Cast", place, to=TensorProto.FLOAT), g("Cast", told, to=TensorProto.FLOAT)


def _number(g: GraphNodes, value: ArrayLike) -> str:
    """Numbers in double precision: arrays, which single precision holds, take half the room in it."""
    if np.ndim(value) == 0:
        return g.constant(value, np.float64)
    return g("Cast", g.constant(value, np.float32), to=TensorProto.DOUBLE)


def _on_grid(g: GraphNodes, observer: Observer, seen: str, there: str) -> tuple[str, str, str]:
    """Mean place (Q, 2), its variances (Q, 2) and correlation (Q, 1)."""
    first, second = (g.constant(each) for each in np.triu_indices(COMPONENTS))
    products = g("Mul", g("Gather", seen, first, axis=2), g("Gather", seen, second, axis=2))
    known = g("Reshape", g("Concat", products, seen, there, axis=2), g.constant([-1, len(observer.terms)]))
    share = g("Softmax", g("MatMul", known, _number(g, observer.terms)), axis=1)
    grid = observer.grid
    moments = g("MatMul", share, g.constant(np.column_stack([grid, grid**2, grid[:, 0] * grid[:, 1]]), np.float64))
    mean = g.part(moments, 0, 2, axis=1)
    limits = (_number(g, limit) for limit in (LEAST_SPREAD**2, 4))
    variance = g("Clip", g("Sub", g.part(moments, 2, 4, axis=1), g("Mul", mean, mean)), *limits)
    between = g("Sub", g.part(moments, 4, 5, axis=1), g("Mul", g.part(mean, 0, 1, axis=1), g.part(mean, 1, 2, axis=1)))
    whole = g("Sqrt", g("Mul", g.part(variance, 0, 1, axis=1), g.part(variance, 1, 2, axis=1)))
    return mean, variance, g("Clip", g("Div", between, whole), _number(g, -1), _number(g, 1))


def _looked_up(g: GraphNodes, flat: str, side: int, place: str) -> str:
    """(Q, C (3 D + 3)), as `response_model.looked_up`."""
    at = g("Mul", g("Add", place, _number(g, 1)), _number(g, (side - 1) / 2))
    at = g("Clip", at, _number(g, 0), _number(g, side - 1 - 1e-3))
    whole = g("Floor", at)
    part = g("Sub", at, whole)
    corner = g("ReduceSum", g("Mul", whole, _number(g, [side, 1])), g.constant([1]), keepdims=0)
    corner = g("Cast", corner, to=TensorProto.INT64)
    x, y = g.part(part, 0, 1, axis=1), g.part(part, 1, END, axis=1)

    def between(low: str, high: str, share: str) -> str:
        return g("Add", low, g("Mul", share, g("Sub", high, low)))

    def row(by: int) -> str:
        return g("Gather", flat, g("Add", corner, g.constant(by)), axis=0)

    return between(between(row(0), row(1), y), between(row(side), row(side + 1), y), x)


def _solved(g: GraphNodes, curved: str, known: str, pull: str) -> tuple[str, str]:
    """(Q, 2) variances and steps, as `observer._solved`."""
    own, both = g.part(curved, 0, 2, axis=1), g.part(curved, 2, 3, axis=1)
    x, y = g.part(own, 0, 1, axis=1), g.part(own, 1, 2, axis=1)
    known_x, known_y = g.part(known, 0, 1, axis=1), g.part(known, 1, 2, axis=1)
    plain = g("Relu", g("Sub", g("Mul", x, y), g("Mul", both, both)))
    more = g("Add", g("Add", g("Mul", x, known_y), g("Mul", y, known_x)), g("Mul", known_x, known_y))
    whole = g("Add", plain, more)
    swap = g.constant([1, 0])
    turned = g("Gather", g("Add", own, known), swap, axis=1)
    across = g("Mul", both, g("Gather", pull, swap, axis=1))
    return g("Div", turned, whole), g("Div", g("Sub", g("Mul", turned, pull), across), whole)
