"""ONNX operators by name, and the few programs of linear algebra that ONNX has no operators for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

_OPSET, _IR = 18, 9


class OnnxGraph:
    """A graph as it is written: ``graph.Add(a, b)`` adds a node and gives its output's name; arrays become constants.

    Everything is float64; the first dimension is the batch.
    """

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[tuple[Any, ...], str] = {}
        self._tensors: list[onnx.TensorProto] = []

    def __getattr__(self, operator: str) -> Any:
        if not operator[0].isupper():
            raise AttributeError(operator)

        def node(*inputs: Any, outputs: int = 1, **attributes: Any) -> Any:
            names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
            made = [f"t{len(self._nodes)}_{k}" for k in range(outputs)]
            self._nodes.append(helper.make_node(operator, names, made, **attributes))
            return made[0] if outputs == 1 else made

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

    def solved(self, matrix: str, right: str, n: int) -> str:
        """matrix^-1 right, (batch, n, 1), by Gauss and Jordan: positive definite matrices need no pivoting."""
        rows = self.Concat(matrix, right, axis=2)
        for k in range(n):
            row = self._slice(rows, k, k + 1, 1)
            column = self.Sub(self._slice(rows, k, k + 1, 2), np.eye(n)[:, k : k + 1])
            rows = self.Sub(rows, self.Mul(self.Div(column, self._slice(row, k, k + 1, 2)), row))
        return self._slice(rows, n, n + 1, 2)

    def _slice(self, x: str, start: int, stop: int, axis: int) -> str:
        found: str = self.Slice(x, np.array([start]), np.array([stop]), np.array([axis]))
        return found

    def model(
        self, inputs: Mapping[str, Sequence[int]], output: str, name: str, shape: Sequence[int]
    ) -> bytes:
        """The serialised model; shapes are without the batch. ``name``: of the output."""
        self._nodes.append(helper.make_node("Identity", [output], [name]))
        described = [
            helper.make_tensor_value_info(key, TensorProto.DOUBLE, ["batch", *size])
            for key, size in inputs.items()
        ]
        found = helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["batch", *shape])
        graph = helper.make_graph(self._nodes, name, described, [found], self._tensors)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
        onnx.checker.check_model(model)
        content: bytes = model.SerializeToString()
        return content
