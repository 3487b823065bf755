"""The localizer as one ONNX graph: from readings, and when they were of a press, to places with their radii."""

from collections.abc import Mapping

import numpy as np
import onnx
from onnx import TensorProto, helper

from padforge.sense.localizer.features import SIZES
from padforge.sense.localizer.localizer import UNKNOWN, Localizer
from padforge.sense.localizer.locating import MEASURED
from padforge.sense.localizer.network import EPSILON, LEAST_LOG, MOST_LOG, Weights
from padforge.sense.localizer.normalization import MAX_INPUT

from padforge.sense.live.deployment.onnx_graph.features_graph import END, GraphNodes, PressFeatures, volts
from padforge.sense.live.deployment.onnx_graph.observer_graph import observed

OPSET = 18
"""Of the operators: that of ONNX 1.13, from 2022 on."""
INPUTS = {
    "readings": "V, (R, C): one row a reading, one column a fibre, none missing",
    "begun": "(Q,), ascending: row of the first reading after the probe was sent down",
    "lifted": "(Q,): row of the first reading after it was sent up; R where there is none yet",
    "alive": "(Q, C): which fibres count in each press",
}
OUTPUTS = {
    "places_mm": "mm from the middle of the pad, x and y",
    "sd_mm": "mm, standard deviation in x and in y",
    "r50_mm": "mm, radius around the place that holds the press in 50 % of cases",
    "r90_mm": "mm, the same in 90 % of cases",
}
MEASURES = {
    "depth_mm": "mm, how deep the press was",
    "depth_r90_mm": "mm, how far beside it 90 % of presses are at most",
    "force_n": "N, force of the press",
    "force_r90_n": "N, how far beside it 90 % of presses are at most",
}


def onnx_model(localizer: Localizer, metadata: Mapping[str, str]) -> onnx.ModelProto:
    """One graph that gives, of any number of presses, what `locate` gives.

    Args:
        metadata: what the file says of itself, beside its inputs and outputs.
    """
    graph = GraphNodes()
    outputs = _located(graph, localizer)
    for name, computed in outputs.items():
        graph.nodes.append(helper.make_node("Cast", [computed], [name], to=TensorProto.FLOAT))
    fibres = localizer.fibres
    given = {
        "readings": (TensorProto.DOUBLE, ["readings", fibres]),
        "begun": (TensorProto.INT64, ["presses"]),
        "lifted": (TensorProto.INT64, ["presses"]),
        "alive": (TensorProto.BOOL, ["presses", fibres]),
    }
    about = INPUTS | OUTPUTS | MEASURES
    shapes = {name: ["presses", 2] if name in ("places_mm", "sd_mm") else ["presses"] for name in outputs}
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "localizer",
            [helper.make_tensor_value_info(name, *of, doc_string=about[name]) for name, of in given.items()],
            [
                helper.make_tensor_value_info(name, TensorProto.FLOAT, shape, doc_string=about[name])
                for name, shape in shapes.items()
            ],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=8,
        producer_name="padforge",
    )
    helper.set_model_props(model, dict(metadata))
    return model


def _located(g: GraphNodes, localizer: Localizer) -> dict[str, str]:
    """What computes each output, by its name, as `Localizer.locate`."""
    scaling, alive = localizer.normalization, g("Cast", "alive", to=TensorProto.FLOAT)
    kept = _inputs(g, localizer)
    entries = g("Concat", g("Reshape", kept, g.constant([0, scaling.centre.size])), alive, axis=1)
    outputs = _network(g, localizer.weights, entries)
    if localizer.observer is not None:
        place, told = observed(g, localizer.observer, kept, alive)
        corrected = _network(g, localizer.corrector, g("Concat", entries, told, axis=1))
        more = g("Pad", place, g.constant([0, 0, 0, 2]), g.constant(0, np.float32))
        outputs = g("Concat", outputs, g("Add", corrected, more), axis=0)
    numbers, spreads = _pooled(g, outputs, localizer)
    left = g("ReduceSum", alive, g.constant([1]), keepdims=0)
    blind = g("Less", left, g.constant(0.5, np.float32))
    lost = g("Cast", g("Sub", g.constant(localizer.fibres, np.float32), left), to=TensorProto.INT64)
    level = g("Min", lost, g.constant(len(localizer.factors) - 1))

    def factor(column: int, unit: float) -> str:
        return g("Gather", g.constant(localizer.factors[:, column] * unit, np.float32), level, axis=0)

    def known(value: str, unknown: float, condition: str = blind) -> str:
        return g("Where", condition, g.constant(unknown, np.float32), value)

    place, spread = (g.part(each, 0, 2, axis=1) for each in (numbers, spreads))
    radius = g("ReduceL2", spread, g.constant([1]), keepdims=0)
    span, every = scaling.span_mm, g.column(blind)
    there = g("Mul", known(place, 0.0, every), g.constant(span, np.float32))
    out = {
        "places_mm": g("Add", there, g.constant(scaling.middle_mm, np.float32)),
        "sd_mm": known(g("Mul", g.column(factor(0, span)), spread), UNKNOWN[0] * span, every),
        "r50_mm": known(g("Mul", factor(1, span), radius), UNKNOWN[1] * span),
        "r90_mm": known(g("Mul", factor(2, span), radius), UNKNOWN[2] * span),
    }
    for column, target in enumerate(scaling.measures):
        value, half = (g("Gather", each, g.constant(2 + column), axis=1) for each in (numbers, spreads))
        scaled = g("Mul", known(value, 0.0), g.constant(target.span, np.float32))
        value_name, half_name = MEASURED[target.name]
        out[value_name] = g("Add", scaled, g.constant(target.middle, np.float32))
        out[half_name] = known(g("Mul", factor(3 + column, target.span), half), target.span)
    return out


def _inputs(g: GraphNodes, localizer: Localizer) -> str:
    """(Q, C, F + G) scaled inputs, 0 for lost fibres."""
    scaling, features = localizer.normalization, PressFeatures(g, localizer.fibres)
    windows = features.windows(localizer.features)
    if scaling.usual.size:
        history = g("Sub", features.history(), volts(scaling.usual, g))
        shown = g("MatMul", g("Transpose", history, perm=[1, 0, 2]), volts(scaling.memory, g))
        gains = scaling.memory.shape[2] - SIZES[localizer.features]
        windows = g("Pad", windows, g.constant([0, 0, 0, 0, 0, gains]), volts(np.array(0.0), g))
        windows = g("Sub", windows, g("Transpose", shown, perm=[1, 0, 2]))
    scaled = g("Div", g("Sub", windows, volts(scaling.centre, g)), volts(scaling.spread, g))
    limits = (volts(np.array(limit), g) for limit in (-MAX_INPUT, MAX_INPUT))
    inputs = g("Cast", g("Clip", scaled, *limits), to=TensorProto.FLOAT)
    return g("Where", g("Unsqueeze", "alive", g.constant([2])), inputs, g.constant(0, np.float32))


def _network(g: GraphNodes, weights: Weights, entries: str) -> str:
    """(E, Q, 2 N), as `network.forward`."""

    def layer(x: str, w: np.ndarray, b: np.ndarray) -> str:
        return g("Add", g("MatMul", x, g.constant(w, np.float32)), g.constant(b, np.float32))

    def ready(x: str) -> str:
        ones = g.constant(np.ones(weights["first.w"].shape[2]), np.float32)
        x = g("LayerNormalization", x, ones, axis=-1, epsilon=EPSILON)
        tails = g("Erf", g("Mul", x, g.constant(0.5**0.5, np.float32)))
        return g("Mul", g("Mul", x, g.constant(0.5, np.float32)), g("Add", tails, g.constant(1, np.float32)))

    h = layer(entries, weights["first.w"], weights["first.b"])
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = g("Add", h, layer(ready(h), w, b))
    return layer(ready(h), weights["last.w"], weights["last.b"])


def _pooled(g: GraphNodes, outputs: str, localizer: Localizer) -> tuple[str, str]:
    """(Q, N) numbers learnt and their standard deviations, as `network.pooled`."""
    numbers = 2 + len(localizer.normalization.measures)
    learnt = g.part(outputs, 0, numbers, axis=2)
    limits = (g.constant(limit, np.float32) for limit in (LEAST_LOG, MOST_LOG))
    logs = g("Clip", g.part(outputs, numbers, END, axis=2), *limits)
    two, members = g.constant(2, np.float32), g.constant([0])
    variance = g("Mul", two, g("Exp", g("Mul", two, logs)))
    doubt = g.mean(g.part(variance, 0, 2, axis=2), 2, keep=True)
    sure = g("Reciprocal", g("Concat", doubt, doubt, g.part(variance, 2, END, axis=2), axis=2))
    share = g("Div", sure, g("ReduceSum", sure, members, keepdims=1))
    mean = g("ReduceSum", g("Mul", share, learnt), members, keepdims=1)
    off = g("Sub", learnt, mean)
    whole = g("Mul", share, g("Add", variance, g("Mul", off, off)))
    return g("Squeeze", mean, members), g("Sqrt", g("ReduceSum", whole, members, keepdims=0))
