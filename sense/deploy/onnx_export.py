"""What `sense.localizer.features` computes, as nodes of an ONNX graph: from readings to the windows of presses.

What `padforge.sense.localizer.bayes` computes, as nodes of an ONNX graph: from inputs to a place.

The localizer as one ONNX graph: from readings, and when they were of a press, to places with their radii.

`localizer.onnx`: written only if onnxruntime finds the places in it that the localizer itself finds.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from padforge.design.common.files import atomic_file
from padforge.design.common.validation import Fault, InputError
from padforge.sense.arrays import Array, Indices, Mask
from padforge.sense.localizer import features
from padforge.sense.localizer.bayes import (
    COMPONENTS,
    GAUSS_NEWTON_STEPS,
    MAX_STEP,
    MIN_STD,
    PRIOR_WEIGHT,
    BayesianLocalizer,
)
from padforge.sense.localizer.features import (
    DOWN,
    FEATURES,
    MEDIAN,
    PAST,
    REST,
    SLOW,
    SLOW_SAMPLES,
    UP,
    Window,
    compute_features,
    interpolate_gaps,
)
from padforge.sense.localizer.model import MEASURE_COLUMNS, UNIFORM, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.network import EPSILON, MAX_LOG_ERROR, MIN_LOG_ERROR, Weights
from padforge.sense.localizer.scaler import MAX_INPUT
from padforge.sense.recording.recording import Recording

END = np.iinfo(np.int64).max


class GraphNodes:
    """The nodes and constants of a graph, each made by a call that gives the name of what it computes."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def __call__(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """A node of the ONNX operator `kind`."""
        name = f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def constant(self, values: Any, kind: type = np.int64) -> str:
        """Numbers that are part of the graph."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=kind, order="C"), name))
        return name

    def part(self, array: str, begin: int, end: int, axis: int = 0) -> str:
        """begin <= index < end along an axis."""
        return self("Slice", array, *(self.constant([each]) for each in (begin, end, axis)))

    def column(self, array: str) -> str:
        """(Q,) to (Q, 1)."""
        return self("Unsqueeze", array, self.constant([1]))

    def mean(self, array: str, axis: int, keep: bool = False) -> str:
        """Means along an axis, which is gone then unless it is to be kept."""
        return self("ReduceMean", array, self.constant([axis]), keepdims=int(keep))

    def median(self, array: str, size: int) -> str:
        """(Q, size, C) to (Q, C)."""
        middle = size // 2
        name = f"least_{len(self.nodes)}"
        size_wanted = self.constant([middle + 1])
        outputs = [name, f"{name}_at"]
        self.nodes.append(helper.make_node("TopK", [array, size_wanted], outputs, axis=1, largest=0, sorted=1))
        return self.mean(self.part(name, middle - (size % 2 == 0), middle + 1, axis=1), 1)


class PressFeatures:
    """The inputs of presses, from `readings` (R, C) V in double precision, `down_command` and `up_command` (Q,)."""

    def __init__(self, graph: GraphNodes, fibres: int) -> None:
        self._g, self._fibres = graph, fibres
        self._length = graph.part(graph("Shape", "readings"), 0, 1)
        self._free = graph("Concat", graph.constant([0]), graph.part("up_command", 0, -1), axis=0)
        self._following = graph("Concat", graph.part("down_command", 1, END), self._length, axis=0)

    def windows(self, kind: str) -> str:
        """(Q, C, F) V, as `features.compute_features`."""
        if kind == "published":
            reach = (-(MEDIAN // 2), MEDIAN // 2 + 1)
            ranges = (
                ("down_command", -10, self._free, "down_command"),
                ("down_command", 10, "down_command", "up_command"),
                ("up_command", 10, "down_command", self._following),
            )
            found = [
                self._g.median(self._gathered(at, (reach[0] + by, reach[1] + by), low, high), MEDIAN)
                for at, by, low, high in ranges
            ]
            return self._stacked(found)
        found = [self._mean("down_command", window, "down_command", "up_command") for window in DOWN[: FEATURES[kind].n_windows]]
        if kind == "press_and_release":
            found += [self._mean("up_command", window, "down_command", self._following) for window in UP]
        return self._g("Sub", self._stacked(found), self._rest(REST, "down_command"))

    def history(self) -> str:
        """(Q, C, J) V, as `features.compute_history`."""
        g = self._g
        level = g.part("readings", 0, 1)
        sums = g("CumSum", g("Sub", "readings", level), g.constant(np.int64(0)))
        sums = g("Concat", g.constant(np.zeros((1, self._fibres)), np.float64), sums, axis=0)

        def mean(window: Window) -> str:
            first = g("Max", g("Add", "down_command", g.constant([window[0]])), g.constant([0]))
            end = g("Max", g("Add", "down_command", g.constant([window[1]])), g("Add", first, g.constant([1])))
            count = g("Cast", g.column(g("Sub", end, first)), to=onnx.TensorProto.DOUBLE)
            total = g("Sub", g("Gather", sums, end, axis=0), g("Gather", sums, first, axis=0))
            return g("Add", g("Div", total, count), level)

        found = [mean(window) for window in PAST]
        for length in SLOW:
            offsets = np.arange(-length, 0, length // SLOW_SAMPLES)
            index = g("Max", g("Add", g.column("down_command"), g.constant(offsets)), g.constant([0]))
            found.append(g.median(g("Gather", "readings", index, axis=0), len(offsets)))
        return g("Sub", self._stacked(found), g("Unsqueeze", mean(features.REST), g.constant([2])))

    def _rest(self, window: Window, at: str) -> str:
        return self._g("Unsqueeze", self._mean(at, window, self._free, at), self._g.constant([2]))

    def _mean(self, at: str, window: Window, low: str, high: str) -> str:
        return self._g.mean(self._gathered(at, window, low, high), 1)

    def _gathered(self, at: str, window: Window, low: str, high: str) -> str:
        """(Q, W, C) readings `at` + window, held within low <= index < high (and within the readings)."""
        g = self._g
        index = g("Add", g.column(at), g.constant(np.arange(*window)))
        most = g("Sub", g("Min", high, self._length), g.constant([1]))
        index = g("Min", g("Max", index, g.column(low)), g.column(most))
        return g("Gather", "readings", index, axis=0)

    def _stacked(self, columns: list[str]) -> str:
        """(Q, C) each, to (Q, C, n)."""
        axis = self._g.constant([2])
        return self._g("Concat", *(self._g("Unsqueeze", each, axis) for each in columns), axis=2)


def volts(values: Array, graph: GraphNodes) -> str:
    """Numbers in double precision, as readings are."""
    return graph.constant(values, np.float64)


def observed(g: GraphNodes, bayes: BayesianLocalizer, inputs: str, fibre_mask: str) -> tuple[str, str]:
    """Places (Q, 2) and what is told of them (Q, `N_SUMMARY`), as `BayesianLocalizer.predict`, of inputs that are 0 where lost."""
    fibres, size = len(bayes.projection), COMPONENTS
    inputs, fibre_mask = (g("Cast", each, to=TensorProto.DOUBLE) for each in (inputs, fibre_mask))
    there = g("Unsqueeze", fibre_mask, g.constant([2]))
    by_fibre = g("MatMul", g("Transpose", inputs, perm=[1, 0, 2]), _number(g, bayes.projection))
    seen = g("Transpose", by_fibre, perm=[1, 0, 2])
    mean, variance, both = _on_grid(g, bayes, seen, there)
    known, place = g("Div", _number(g, PRIOR_WEIGHT), variance), mean
    spread, answers = variance, _number(g, bayes.linearization.reshape(len(bayes.linearization) ** 2, -1))
    for _ in range(GAUSS_NEWTON_STEPS):
        found = _looked_up(g, answers, len(bayes.linearization), place)

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
        step = g("Clip", step, _number(g, -MAX_STEP), _number(g, MAX_STEP))
        within = g("Max", g("Add", place, step), _number(g, bayes.bounds[0]))
        place = g("Min", within, _number(g, bayes.bounds[1]))
    two = _number(g, 2)
    logs = (g("Add", _number(g, 1), g("Mul", _number(g, 0.25), g("Log", each))) for each in (spread, variance))
    of_place, of_mean = logs
    told = g("Concat", g("Mul", two, place), of_place, g("Mul", two, mean), of_mean, both, axis=1)
    place = g("Add", g("MatMul", place, _number(g, bayes.rotation.T)), _number(g, bayes.shift))
    return g("Cast", place, to=TensorProto.FLOAT), g("Cast", told, to=TensorProto.FLOAT)


def _number(g: GraphNodes, value: ArrayLike) -> str:
    """Numbers in double precision: arrays, which single precision holds, take half the room in it."""
    if np.ndim(value) == 0:
        return g.constant(value, np.float64)
    return g("Cast", g.constant(value, np.float32), to=TensorProto.DOUBLE)


def _on_grid(g: GraphNodes, bayes: BayesianLocalizer, seen: str, there: str) -> tuple[str, str, str]:
    """Mean place (Q, 2), its variances (Q, 2) and correlation (Q, 1)."""
    first, second = (g.constant(each) for each in np.triu_indices(COMPONENTS))
    products = g("Mul", g("Gather", seen, first, axis=2), g("Gather", seen, second, axis=2))
    known = g("Reshape", g("Concat", products, seen, there, axis=2), g.constant([-1, len(bayes.log_likelihood_coefficients)]))
    share = g("Softmax", g("MatMul", known, _number(g, bayes.log_likelihood_coefficients)), axis=1)
    grid = bayes.grid
    moments = g("MatMul", share, g.constant(np.column_stack([grid, grid**2, grid[:, 0] * grid[:, 1]]), np.float64))
    mean = g.part(moments, 0, 2, axis=1)
    limits = (_number(g, limit) for limit in (MIN_STD**2, 4))
    variance = g("Clip", g("Sub", g.part(moments, 2, 4, axis=1), g("Mul", mean, mean)), *limits)
    between = g("Sub", g.part(moments, 4, 5, axis=1), g("Mul", g.part(mean, 0, 1, axis=1), g.part(mean, 1, 2, axis=1)))
    whole = g("Sqrt", g("Mul", g.part(variance, 0, 1, axis=1), g.part(variance, 1, 2, axis=1)))
    return mean, variance, g("Clip", g("Div", between, whole), _number(g, -1), _number(g, 1))


def _looked_up(g: GraphNodes, flat: str, side: int, place: str) -> str:
    """(Q, C (3 D + 3)), as `response_model.interpolate_grid`."""
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
    """(Q, 2) variances and steps, as `bayes.solve_2x2`."""
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


OPSET = 18
"""Of the operators: that of ONNX 1.13, from 2022 on."""
INPUTS = {
    "readings": "V, (R, C): one row a reading, one column a fibre, none missing",
    "down_command": "(Q,), ascending: row of the first reading after the probe was sent down",
    "up_command": "(Q,): row of the first reading after it was sent up; R where there is none yet",
    "fibre_mask": "(Q, C): which fibres count in each press",
}
OUTPUTS = {
    "positions_mm": "mm from the middle of the pad, x and y",
    "std_mm": "mm, standard deviation in x and in y",
    "r50_mm": "mm, radius around the place that holds the press in 50 % of cases",
    "r90_mm": "mm, the same in 90 % of cases",
}
MEASURES = {
    "depth_mm": "mm, how deep the press was",
    "depth_r90_mm": "mm, how far beside it 90 % of presses are at most",
    "force_n": "N, force of the press",
    "force_r90_n": "N, how far beside it 90 % of presses are at most",
}


def onnx_model(localizer: LocalizerModel, metadata: Mapping[str, str]) -> onnx.ModelProto:
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
        "down_command": (TensorProto.INT64, ["presses"]),
        "up_command": (TensorProto.INT64, ["presses"]),
        "fibre_mask": (TensorProto.BOOL, ["presses", fibres]),
    }
    about = INPUTS | OUTPUTS | MEASURES
    shapes = {name: ["presses", 2] if name in ("positions_mm", "std_mm") else ["presses"] for name in outputs}
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


def _located(g: GraphNodes, localizer: LocalizerModel) -> dict[str, str]:
    """What computes each output, by its name, as `LocalizerModel.predict_features`."""
    scaling, fibre_mask = localizer.scaler, g("Cast", "fibre_mask", to=TensorProto.FLOAT)
    kept = _inputs(g, localizer)
    entries = g("Concat", g("Reshape", kept, g.constant([0, scaling.mean_v.size])), fibre_mask, axis=1)
    outputs = _network(g, localizer.weights, entries)
    if localizer.bayes is not None:
        place, told = observed(g, localizer.bayes, kept, fibre_mask)
        corrected = _network(g, localizer.residual_network, g("Concat", entries, told, axis=1))
        more = g("Pad", place, g.constant([0, 0, 0, 2]), g.constant(0, np.float32))
        outputs = g("Concat", outputs, g("Add", corrected, more), axis=0)
    numbers, spreads = _pooled(g, outputs, localizer)
    left = g("ReduceSum", fibre_mask, g.constant([1]), keepdims=0)
    blind = g("Less", left, g.constant(0.5, np.float32))
    lost = g("Cast", g("Sub", g.constant(localizer.fibres, np.float32), left), to=TensorProto.INT64)
    level = g("Min", lost, g.constant(len(localizer.interval_factors) - 1))

    def factor(column: int, unit: float) -> str:
        return g("Gather", g.constant(localizer.interval_factors[:, column] * unit, np.float32), level, axis=0)

    def known(value: str, unknown: float, condition: str = blind) -> str:
        return g("Where", condition, g.constant(unknown, np.float32), value)

    place, spread = (g.part(each, 0, 2, axis=1) for each in (numbers, spreads))
    radius = g("ReduceL2", spread, g.constant([1]), keepdims=0)
    span, every = scaling.scale_mm, g.column(blind)
    there = g("Mul", known(place, 0.0, every), g.constant(span, np.float32))
    out = {
        "positions_mm": g("Add", there, g.constant(scaling.origin_mm, np.float32)),
        "std_mm": known(g("Mul", g.column(factor(0, span)), spread), UNIFORM[0] * span, every),
        "r50_mm": known(g("Mul", factor(1, span), radius), UNIFORM[1] * span),
        "r90_mm": known(g("Mul", factor(2, span), radius), UNIFORM[2] * span),
    }
    for column, target in enumerate(scaling.measures):
        value, half = (g("Gather", each, g.constant(2 + column), axis=1) for each in (numbers, spreads))
        scaled = g("Mul", known(value, 0.0), g.constant(target.scale, np.float32))
        value_name, half_name = MEASURE_COLUMNS[target.name]
        out[value_name] = g("Add", scaled, g.constant(target.origin, np.float32))
        out[half_name] = known(g("Mul", factor(3 + column, target.scale), half), target.scale)
    return out


def _inputs(g: GraphNodes, localizer: LocalizerModel) -> str:
    """(Q, C, F + G) scaled inputs, 0 for lost fibres."""
    scaling, features = localizer.scaler, PressFeatures(g, localizer.fibres)
    windows = features.windows(localizer.features)
    if scaling.history_mean_v.size:
        history = g("Sub", features.history(), volts(scaling.history_mean_v, g))
        shown = g("MatMul", g("Transpose", history, perm=[1, 0, 2]), volts(scaling.history_coef, g))
        gains = scaling.history_coef.shape[2] - FEATURES[localizer.features].n_windows
        windows = g("Pad", windows, g.constant([0, 0, 0, 0, 0, gains]), volts(np.array(0.0), g))
        windows = g("Sub", windows, g("Transpose", shown, perm=[1, 0, 2]))
    scaled = g("Div", g("Sub", windows, volts(scaling.mean_v, g)), volts(scaling.scale_v, g))
    limits = (volts(np.array(limit), g) for limit in (-MAX_INPUT, MAX_INPUT))
    inputs = g("Cast", g("Clip", scaled, *limits), to=TensorProto.FLOAT)
    return g("Where", g("Unsqueeze", "fibre_mask", g.constant([2])), inputs, g.constant(0, np.float32))


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


def _pooled(g: GraphNodes, outputs: str, localizer: LocalizerModel) -> tuple[str, str]:
    """(Q, N) numbers learnt and their standard deviations, as `network.combine_members`."""
    numbers = 2 + len(localizer.scaler.measures)
    learnt = g.part(outputs, 0, numbers, axis=2)
    limits = (g.constant(limit, np.float32) for limit in (MIN_LOG_ERROR, MAX_LOG_ERROR))
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


FORMAT = "padforge-onnx/2"
MOST_OFF_MM = 1e-4
"""A graph whose places differ by more from those of its localizer is not written."""
TRIED = 64
"""Presses made up to try a graph on where there is no recording."""
CYCLE = 40
"""Readings from one of them to the next."""


class Exported(NamedTuple):
    """What was written: bytes of the file, presses it was tried on, with up to so many fibres lost, and the greatest
    distance, mm, of a place from that of the localizer, and difference, mm, of a radius of 90 %."""

    size: int
    presses: int
    lost: int
    positions_mm: float
    radii_mm: float


class _Readings(NamedTuple):
    readings: Array
    down_command: Indices
    up_command: Indices


def onnx_line(found: Exported) -> str:
    """The same for people."""
    return (
        f"{found.size / 1e6:.1f} MB, tried on {found.presses} presses with up to {found.lost} fibres lost: "
        f"places within {1e3 * found.positions_mm:.2f} µm of the localizer's, radii within {1e3 * found.radii_mm:.2f} µm"
    )


def export_onnx(localizer: LocalizerModel, digest: str, path: Path, recording: Recording | None = None) -> Exported:
    """Write `localizer` as an ONNX graph, tried on the presses of `recording`, or on some made up.

    Args:
        digest: of its `localizer.json`, which has that of its weights.

    Raises:
        InputError: it is of the published method, the recording is of another pad or rate, or `path` cannot be written.
        Fault: places differ by more than `MOST_OFF_MM`.
    """
    if localizer.method != "ensemble":
        raise InputError(f"the localizer is of method {localizer.method}, expected ensemble: calibrate again")
    if recording is not None:
        check_same_pad(localizer, "the localizer", recording.fibres, recording.rate_hz)
    metadata = {
        "format": FORMAT,
        "padforge": version("padforge"),
        "localizer_sha256": digest,
        "training_recording_sha256": localizer.training_recording_sha256,
        "features": localizer.features,
        "rate_hz": f"{localizer.rate_hz:.9g}",
        "fibres": json.dumps([f"fibre_{fibre}_v" for fibre in range(localizer.fibres)]),
        "inputs": json.dumps(INPUTS),
        "outputs": json.dumps(OUTPUTS | {name: MEASURES[name] for name in _measured(localizer)}),
    }
    content = onnx_model(localizer, metadata).SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    tried = _made_up(localizer) if recording is None else _of(recording)
    places, radii, lost = _differences(localizer, session, tried)
    if not places <= MOST_OFF_MM:
        raise Fault(
            f"{path}: not written, onnxruntime finds places {places:.2g} mm off those of the localizer, "
            f"allowed are {MOST_OFF_MM:g} mm"
        )
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
    return Exported(len(content), len(tried.down_command), lost, places, radii)


def _measured(localizer: LocalizerModel) -> list[str]:
    kinds = [target.name.rsplit("_", 1) for target in localizer.scaler.measures]
    return [f"{kind}{part}_{unit}" for kind, unit in kinds for part in ("", "_r90")]


def _of(recording: Recording) -> _Readings:
    return _Readings(recording.readings, recording.down_command, recording.up_command)


def _made_up(localizer: LocalizerModel) -> _Readings:
    """Readings of presses as strong as those that were learnt from, wherever such may be."""
    rng, scaling = np.random.default_rng(0), localizer.scaler
    down_command = CYCLE // 2 + CYCLE * np.arange(TRIED)
    up_command = down_command + DOWN[-1][1]
    readings = 1e-3 * rng.standard_normal((TRIED * CYCLE + CYCLE, localizer.fibres))
    strength = np.abs(scaling.mean_v).max(axis=1) + scaling.scale_v.max(axis=1)
    for first, end in zip(down_command, up_command, strict=True):
        readings[first:end] += strength * rng.uniform(-1, 1, localizer.fibres)
    return _Readings(readings, down_command, up_command)


def _differences(
    localizer: LocalizerModel, session: onnxruntime.InferenceSession, tried: _Readings
) -> tuple[float, float, int]:
    """Greatest distance of places, and difference of radii, mm, over all levels of loss that it was trained for."""
    presses = localizer.scaler.transform(compute_features(*tried, localizer.features))
    rng, most = np.random.default_rng(0), len(localizer.interval_factors) - 1
    off: list[tuple[float, float]] = []
    for lost in range(most + 1):
        fibre_mask = presses.fibre_mask & _without(presses.fibre_mask.shape, lost, rng)
        found = localizer.predict_features(replace(presses, fibre_mask=fibre_mask))
        given = {
            "readings": interpolate_gaps(tried.readings),
            "down_command": tried.down_command,
            "up_command": tried.up_command,
            "fibre_mask": fibre_mask,
        }
        places, r90 = map(np.asarray, session.run(["positions_mm", "r90_mm"], given))
        off.append((float(np.hypot(*(places - found.positions_mm).T).max()), float(np.abs(r90 - found.r90_mm).max())))
    worst = np.max(off, axis=0)
    return float(worst[0]), float(worst[1]), most


def _without(shape: tuple[int, ...], lost: int, rng: np.random.Generator) -> Mask:
    """(Q, C) masks, in every press another random set of so many fibres lost."""
    return rng.random(shape).argsort(axis=1) >= lost
