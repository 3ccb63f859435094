"""ONNX operators by name, and the inverse of a matrix, for which ONNX has no operator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

_OPSET, _IR = 18, 9
_OPSETS = (helper.make_opsetid("", _OPSET), helper.make_opsetid("com.microsoft", 1))


class OnnxGraph:
    """A graph as it is written: ``graph.Add(a, b)`` adds a node and gives its output's name; arrays become constants.

    Everything is float64; the first dimension is the batch. What was asked before is not computed again.
    """

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._known: dict[tuple[Any, ...], Any] = {}
        self._constants: dict[tuple[Any, ...], str] = {}
        self._tensors: list[onnx.TensorProto] = []
        self._functions: list[onnx.FunctionProto] = []

    def __getattr__(self, operator: str) -> Any:
        if not operator[0].isupper():
            raise AttributeError(operator)

        def node(*inputs: Any, outputs: int = 1, **attributes: Any) -> Any:
            names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
            key = (operator, *names, repr(sorted(attributes.items())))
            if key not in self._known:
                made = [f"t{len(self._nodes)}_{k}" for k in range(outputs)]
                self._nodes.append(helper.make_node(operator, names, made, **attributes))
                self._known[key] = made[0] if outputs == 1 else made
            return self._known[key]

        return node

    def constant(self, value: Any) -> str:
        """The name of a constant: float64, or int64 where it is given as integers."""
        array = np.asarray(value)
        array = array.astype(np.int64 if array.dtype.kind == "i" else np.float64)
        key = (array.shape, array.dtype.str, array.tobytes())
        if key not in self._constants:
            self._constants[key] = f"c{len(self._constants)}"
            self._tensors.append(numpy_helper.from_array(array, self._constants[key]))
        return self._constants[key]

    def reshaped(self, x: str, *shape: int) -> str:
        """0 keeps a dimension, -1 takes what is left."""
        found: str = self.Reshape(x, np.array(shape))
        return found

    def split(self, x: str, sizes: Sequence[int], axis: int) -> list[str]:
        """Parts along an axis."""
        if len(sizes) == 1:
            return [x]
        found: list[str] = self.Split(x, np.array(sizes), axis=axis, outputs=len(sizes))
        return found

    def waves(self, q: str, frequencies: Any) -> str:
        """Cosines, then sines of frequencies, (waves, n), times q, (batch, n)."""
        quarter = np.repeat([np.pi / 2, 0.0], len(frequencies))
        found: str = self.Sin(self.Gemm(q, np.tile(frequencies, (2, 1)), quarter, transB=1))
        return found

    def total(self, parts: Sequence[str]) -> str:
        """The sum of one or more."""
        found: str = parts[0] if len(parts) == 1 else self.Sum(*parts)
        return found

    def inverse(self, matrix: str, n: int) -> str:
        """The inverse, (batch, n, n), of positive definite matrices.

        One node of ONNX Runtime's own; to others the file tells it by operators of ONNX.
        """
        if not self._functions:
            self._functions.append(_inverse(n))
        found: str = self.Inverse(matrix, domain="com.microsoft")
        return found

    def model(
        self, inputs: Mapping[str, Sequence[int]], output: str, name: str, shape: Sequence[int]
    ) -> bytes:
        """The serialised model; shapes are without the batch. ``name``: of the output.

        The batch has no name: of known equal sizes ONNX Runtime would use buffers again, which takes it longer.
        """
        self._nodes.append(helper.make_node("Identity", [output], [name]))
        described = [
            helper.make_tensor_value_info(key, TensorProto.DOUBLE, [None, *size])
            for key, size in inputs.items()
        ]
        found = helper.make_tensor_value_info(name, TensorProto.DOUBLE, [None, *shape])
        graph = helper.make_graph(self._nodes, name, described, [found], self._tensors)
        model = helper.make_model(graph, opset_imports=_OPSETS, ir_version=_IR, functions=self._functions)
        onnx.checker.check_model(model)
        content: bytes = model.SerializeToString()
        return content

    def body(self) -> list[onnx.NodeProto]:
        """All nodes, constants among them, for a function."""
        constants = [helper.make_node("Constant", [], [each.name], value=each) for each in self._tensors]
        return [*constants, *self._nodes]


def _inverse(n: int) -> onnx.FunctionProto:
    """By Gauss and Jordan: positive definite matrices need no pivoting."""
    g, eye = OnnxGraph(), np.eye(n)
    rows = g.Concat("X", g.Add(g.Mul("X", 0.0), eye), axis=2)
    for k in range(n):
        row, column = g.Gather(rows, np.array([k]), axis=1), g.Gather(rows, np.array([k]), axis=2)
        scaled = g.Div(row, g.Gather(row, np.array([k]), axis=2))
        rows = g.Sub(rows, g.Mul(g.Sub(column, eye[:, k : k + 1]), scaled))
    last = helper.make_node("Identity", [g.Split(rows, np.array([n, n]), axis=2, outputs=2)[1]], ["Y"])
    return helper.make_function("com.microsoft", "Inverse", ["X"], ["Y"], [*g.body(), last], _OPSETS[:1])
