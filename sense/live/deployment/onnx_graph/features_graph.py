"""What `sense.localizer.features` computes, as nodes of an ONNX graph: from readings to the windows of presses."""

from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from padforge.sense.localizer import features
from padforge.sense.localizer.features import DOWN, MEDIAN, PAST, REST, SIZES, SLOW, SLOW_SAMPLES, UP, Window
from padforge.sense.recordings.processing.limits import Array

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
    """The inputs of presses, from `readings` (R, C) V in double precision, `begun` and `lifted` (Q,)."""

    def __init__(self, graph: GraphNodes, fibres: int) -> None:
        self._g, self._fibres = graph, fibres
        self._length = graph.part(graph("Shape", "readings"), 0, 1)
        self._free = graph("Concat", graph.constant([0]), graph.part("lifted", 0, -1), axis=0)
        self._following = graph("Concat", graph.part("begun", 1, END), self._length, axis=0)

    def windows(self, kind: str) -> str:
        """(Q, C, F) V, as `features.press_inputs`."""
        if kind == "published":
            reach = (-(MEDIAN // 2), MEDIAN // 2 + 1)
            ranges = (
                ("begun", -10, self._free, "begun"),
                ("begun", 10, "begun", "lifted"),
                ("lifted", 10, "begun", self._following),
            )
            found = [
                self._g.median(self._gathered(at, (reach[0] + by, reach[1] + by), low, high), MEDIAN)
                for at, by, low, high in ranges
            ]
            return self._stacked(found)
        found = [self._mean("begun", window, "begun", "lifted") for window in DOWN[: SIZES[kind]]]
        if kind == "full":
            found += [self._mean("lifted", window, "begun", self._following) for window in UP]
        return self._g("Sub", self._stacked(found), self._rest(REST, "begun"))

    def history(self) -> str:
        """(Q, C, J) V, as `features.history`."""
        g = self._g
        level = g.part("readings", 0, 1)
        sums = g("CumSum", g("Sub", "readings", level), g.constant(np.int64(0)))
        sums = g("Concat", g.constant(np.zeros((1, self._fibres)), np.float64), sums, axis=0)

        def mean(window: Window) -> str:
            first = g("Max", g("Add", "begun", g.constant([window[0]])), g.constant([0]))
            end = g("Max", g("Add", "begun", g.constant([window[1]])), g("Add", first, g.constant([1])))
            count = g("Cast", g.column(g("Sub", end, first)), to=onnx.TensorProto.DOUBLE)
            total = g("Sub", g("Gather", sums, end, axis=0), g("Gather", sums, first, axis=0))
            return g("Add", g("Div", total, count), level)

        found = [mean(window) for window in PAST]
        for length in SLOW:
            offsets = np.arange(-length, 0, length // SLOW_SAMPLES)
            index = g("Max", g("Add", g.column("begun"), g.constant(offsets)), g.constant([0]))
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
