"""A trained model's entry points as ONNX graphs of few nodes: for one state a node costs more than its numbers."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph
from spelgen.exporting.onnx_residuals import OnnxResiduals
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
        self._rigid = OnnxRigid(model, self.g, "q")
        self._residuals = OnnxResiduals(model, self.g, "q")

    @cached_property
    def mass_matrix(self) -> str:
        """(batch, n, n)."""
        parts, constant = [self._rigid.mass], self.model.constant_mass
        if constant.any():
            parts.append(self.g.constant(constant))
        return self.g.total([*parts, *([self._residuals.mass] if self._residuals.mass else [])])

    @cached_property
    def gravity(self) -> str:
        """dV/dq."""
        return self.g.total([self._rigid.gravity, *self._residuals.gravity])

    @cached_property
    def bias(self) -> str:
        """Coriolis, centrifugal and gravity torque."""
        return self.g.total([self._rigid.coriolis("qd"), self._rigid.gravity, *self._residuals.bias("qd")])

    @cached_property
    def friction(self) -> str:
        """What friction takes."""
        g, law, bristles = self.g, self.model.friction, self.model.bristles
        speed, loads = self._turned("qd", self.model.motors.T), np.linalg.inv(self.model.motors)
        slow = g.Exp(g.Mul(g.Mul(speed, speed), -1 / law.stribeck_velocity**2))
        sizes, laws = [slow], [law.stribeck]
        if law.load_dependence.any():
            sizes.append(g.Abs(self._turned(self._rigid.gravity, loads)))
            laws.append(law.load_dependence)
        dry = self._combined(sizes, laws, law.coulomb)
        if bristles is None:
            direction = g.Tanh(g.Mul(speed, 1 / law.coulomb_smoothing_velocity))
        else:
            share = np.kron(np.eye(self.n), np.ones((bristles.count, 1)))
            direction = g.MatMul("z", (bristles.fractions / bristles.reach).reshape(-1, 1) * share)
        saturating = g.Tanh(g.Mul(speed, 1 / law.saturation_velocity))
        found = self._combined([speed, saturating], [law.viscous, law.saturation], g.Mul(dry, direction))
        if self._residuals.friction_factor is not None:
            found = g.Mul(found, self._residuals.friction_factor)
        return self._turned(found, self.model.motors)

    def _combined(self, rows: list[str], factors: list[np.ndarray], rest: str | np.ndarray) -> str:
        """Rows times factors, joint by joint, and the rest, as one product."""
        whole = rows[0] if len(rows) == 1 else self.g.Concat(*rows, axis=1)
        found: str = self.g.Gemm(whole, np.concatenate([np.diag(each) for each in factors]), rest)
        return found

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
        inverse = g.inverse(self.mass_matrix, n)
        return g.reshaped(g.MatMul(inverse, g.reshaped(force, 0, n, 1)), 0, n)
