"""A trained model's entry points as ONNX graphs of few nodes: for one state a node costs more than its numbers."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import FrictionLaw, TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph
from spelgen.exporting.onnx_learned import OnnxLearned
from spelgen.exporting.onnx_rigid import OnnxRigid

ENTRIES: dict[str, tuple[tuple[str, ...], str]] = {
    "inverse_dynamics": (("q", "qd", "qdd", "z"), "tau"),
    "forward_dynamics": (("q", "qd", "tau", "z"), "qdd"),
    "mass_matrix": (("q",), "mass"),
    "bias": (("q", "qd"), "bias"),
    "gravity": (("q",), "gravity"),
    "friction": (("q", "qd", "z"), "friction"),
}
"""Inputs, (batch, n) or z (batch, memory) where friction has one, and the output."""


def onnx_model(model: TrainedModel, name: str) -> bytes:
    """The graph of an entry point, any batch size."""
    given, output = ENTRIES[name]
    inputs = {key: [model.memory if key == "z" else model.n] for key in given if key != "z" or model.memory}
    made = _OnnxModel(model)
    shape = [model.n, model.n] if name == "mass_matrix" else [model.n]
    return made.g.model(inputs, getattr(made, name), output, shape)


class _OnnxModel:
    """Quantities by the names of the entry points; (batch, n)."""

    def __init__(self, model: TrainedModel) -> None:
        self.model, self.n, self.g = model, model.n, OnnxGraph()
        self._rigid = None if model.inertias is None else OnnxRigid(model, self.g, "q")
        self._learned = None if model.learned is None else OnnxLearned(model, self.g, "q")

    @cached_property
    def _unbounded(self) -> str:
        g, parts = self.g, []
        if self._rigid is not None:
            parts.append(self._rigid.mass)
        if self._learned is not None:
            parts.append(self._learned.mass)
        if self.model.rotors.any():
            parts.append(g.constant(self.model.rotors))
        found: str = parts[0] if len(parts) == 1 else g.Sum(*parts)
        return found

    @cached_property
    def _part(self) -> str | None:
        """t of the bound, (batch, 1, 1)."""
        bound = None if self.model.learned is None else self.model.learned.bound
        if bound is None:
            return None
        g = self.g
        definite = g.Greater(g.least_pivot(g.Sub(self._unbounded, bound.least), self.n), 0.0)
        missed = g.Mul(g.Sub(self._unbounded, bound.center), bound.unit)
        size = g.ReduceL2(missed, np.array([1, 2]), keepdims=1)
        halvings = g.Max(g.Ceil(g.Mul(g.Log(size), 1 / np.log(2))), 1.0)
        found: str = g.Where(definite, 1.0, g.Pow(0.5, halvings))
        return found

    @cached_property
    def mass_matrix(self) -> str:
        """(batch, n, n)."""
        bound = None if self.model.learned is None else self.model.learned.bound
        if bound is None or self._part is None:
            return self._unbounded
        g = self.g
        found: str = g.Add(g.Mul(g.Sub(self._unbounded, bound.center), self._part), bound.center)
        return found

    @cached_property
    def gravity(self) -> str:
        """dV/dq."""
        parts = []
        if self._rigid is not None:
            parts.append(self.g.reshaped(self._rigid.gravity, 0, self.n))
        if self._learned is not None:
            parts.append(self._learned.gravity())
        found: str = parts[0] if len(parts) == 1 else self.g.Sum(*parts)
        return found

    @cached_property
    def bias(self) -> str:
        """Coriolis, centrifugal and gravity torque."""
        g, n = self.g, self.n
        if self._learned is None:
            assert self._rigid is not None
            return g.reshaped(self._rigid.bias(g.reshaped("qd", 0, 1, n)), 0, n)
        found = self._learned.coriolis("qd")
        if self._rigid is not None:
            by_bodies = self._rigid.bias(g.reshaped("qd", 0, 1, n), gravity=False)
            found = g.Add(found, g.reshaped(by_bodies, 0, n))
        if self._part is not None:
            found = g.Mul(found, g.reshaped(self._part, 0, 1))
        whole: str = g.Add(found, self.gravity)
        return whole

    @cached_property
    def friction(self) -> str:
        """What friction takes."""
        g, law = self.g, self.model.friction
        if isinstance(law, FrictionLaw):
            return self._law(law)
        assert self._learned is not None
        direction = g.Div("qd", g.Sqrt(g.Add(g.Mul("qd", "qd"), law.smoothing)))
        read = g.Concat(self._learned.encoded, "qd", direction, axis=1)
        hidden = g.Sigmoid(g.Gemm(read, law.weight, law.bias, transB=1))
        size = g.Softplus(g.Gemm(hidden, law.out, law.offset, transB=1))
        dry = g.Mul(g.Mul(direction, law.nominal), size)
        found: str = g.Add(g.Mul("qd", law.viscous), dry)
        return found

    def _law(self, law: FrictionLaw) -> str:
        g, bristles = self.g, self.model.bristles
        speed, loads = self._turned("qd", self.model.motors.T), np.linalg.inv(self.model.motors)
        slow = g.Mul(speed, 1 / law.stribeck_velocity)
        dry = g.Add(g.Mul(g.Exp(g.Neg(g.Mul(slow, slow))), law.stribeck), law.coulomb)
        if law.load_dependence.any():
            dry = g.Add(dry, g.Mul(g.Abs(self._turned(self.gravity, loads)), law.load_dependence))
        if bristles is None:
            direction = g.Tanh(g.Mul(speed, 1 / law.coulomb_smoothing_velocity))
        else:
            share = np.kron(np.eye(self.n), np.ones((bristles.count, 1)))
            direction = g.MatMul("z", (bristles.fractions / bristles.reach).reshape(-1, 1) * share)
        saturating = g.Mul(g.Tanh(g.Mul(speed, 1 / law.saturation_velocity)), law.saturation)
        found = g.Sum(g.Mul(speed, law.viscous), saturating, g.Mul(dry, direction))
        return self._turned(found, self.model.motors)

    def _turned(self, rows: str, by: np.ndarray) -> str:
        """Rows times a matrix that is mostly the identity."""
        found: str = rows if np.array_equal(by, np.eye(self.n)) else self.g.MatMul(rows, by)
        return found

    @cached_property
    def inverse_dynamics(self) -> str:
        """tau."""
        g, n, model = self.g, self.n, self.model
        moved = g.reshaped(g.MatMul(self.mass_matrix, g.reshaped("qdd", 0, n, 1)), 0, n)
        force = g.Sum(moved, self.bias, self.friction)
        if model.friction_compensation.any():
            force = g.Sub(force, g.Mul("qd", model.friction_compensation))
        inputs = model.inputs + np.diag(1 - model.actuated)
        if not np.array_equal(inputs, np.eye(n)):
            force = g.MatMul(force, np.linalg.inv(inputs).T)
        found: str = g.Add(force, model.torque_offset) if model.torque_offset.any() else force
        return found

    @cached_property
    def forward_dynamics(self) -> str:
        """qdd."""
        g, n, model = self.g, self.n, self.model
        tau = g.Sub("tau", model.torque_offset) if model.torque_offset.any() else "tau"
        if not np.array_equal(model.inputs, np.eye(n)):
            tau = g.MatMul(tau, model.inputs.T)
        if model.friction_compensation.any():
            tau = g.Add(tau, g.Mul("qd", model.friction_compensation))
        force = g.Sub(g.Sub(tau, self.bias), self.friction)
        found: str = g.reshaped(g.solved(self.mass_matrix, g.reshaped(force, 0, n, 1), n), 0, n)
        return found
