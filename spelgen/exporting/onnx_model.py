"""A trained model's entry points as ONNX graphs of few nodes: for one state a node costs more than its numbers."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph
from spelgen.exporting.onnx_joint_functions import OnnxJointFunctions
from spelgen.exporting.onnx_residuals import SURELY_ONE, OnnxResiduals
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
    made = _OnnxModel(model, moving=name != "mass_matrix")
    shape = [model.n, model.n] if name == "mass_matrix" else [model.n]
    return made.g.model(inputs, getattr(made, name), output, shape)


class _OnnxModel:
    """Quantities by the names of the entry points; (batch, n)."""

    def __init__(self, model: TrainedModel, *, moving: bool) -> None:
        self.model, self.n, self.g = model, model.n, OnnxGraph()
        self._rigid = OnnxRigid(model, self.g, "q")
        self._residuals = OnnxResiduals(model, self.g, "q", moving=moving)
        self._functions = OnnxJointFunctions(model, self.g, "q")

    @cached_property
    def mass_matrix(self) -> str:
        """(batch, n, n)."""
        return self.g.total([self._rigid.mass, *self._residuals.mass])

    @cached_property
    def gravity(self) -> str:
        """dV/dq."""
        return self.g.total([self._rigid_gravity, *self._residual_gravity])

    @cached_property
    def _rigid_gravity(self) -> str:
        return self.g.reshaped(self._rigid.gravity, 0, self.n)

    @cached_property
    def _residual_gravity(self) -> list[str]:
        return [*self._residuals.gravity, *self._functions.torque]

    @cached_property
    def bias(self) -> str:
        """Coriolis, centrifugal and gravity torque."""
        return self.g.total(self._bias)

    @cached_property
    def _bias(self) -> list[str]:
        rising, held = self._rigid.coriolis("qd")
        rows = self.g.total([rising, self._rigid.gravity, *self._residuals.coriolis("qd")])
        return [self.g.reshaped(rows, 0, self.n), held, *self._residual_gravity]

    @cached_property
    def friction(self) -> str:
        """What friction takes."""
        g, law, speed = self.g, self.model.friction, self._turned("qd", self.model.motors.T)
        zero = np.zeros(self.n)
        slow = g.Exp(g.Mul(g.Mul(speed, speed), -1 / law.stribeck_velocity**2))
        saturating = g.Tanh(g.Mul(speed, 1 / law.saturation_velocity))
        # by each what is multiplied by a direction, and what is not
        terms = [(slow, law.stribeck, zero), (speed, zero, law.viscous), (saturating, zero, law.saturation)]
        if law.load_dependence.any():
            load = self._turned(self._rigid_gravity, np.linalg.inv(self.model.motors))
            terms.append((g.Abs(load), law.load_dependence, zero))
        rows = np.concatenate([np.hstack([np.diag(each) for each in laws]) for _, *laws in terms])
        sizes = g.Gemm(g.Concat(*(term for term, *_ in terms), axis=1), rows, np.append(law.coulomb, zero))
        found = g.MatMul(g.Mul(sizes, self._directions(speed)), np.tile(np.eye(self.n), (2, 1)))
        if self._functions.friction_factor is not None:
            found = g.Mul(found, self._functions.friction_factor)
        return self._turned(found, self.model.motors)

    def _directions(self, speed: str) -> str:
        """Of dry friction, and ones, (batch, 2 n)."""
        g, n, law, bristles = self.g, self.n, self.model.friction, self.model.bristles
        if bristles is None:
            rows = np.diag(1 / law.coulomb_smoothing_velocity)
            return g.Tanh(g.Gemm(speed, np.pad(rows, ((0, 0), (0, n))), np.repeat([0.0, SURELY_ONE], n)))
        rows = (bristles.fractions / bristles.reach).reshape(-1, 1) * np.repeat(
            np.eye(n), bristles.count, axis=0
        )
        return g.Gemm("z", np.pad(rows, ((0, 0), (0, n))), np.repeat([0.0, 1.0], n))

    def _turned(self, rows: str, by: np.ndarray) -> str:
        """Rows times a matrix that is mostly the identity."""
        found: str = rows if np.array_equal(by, np.eye(self.n)) else self.g.MatMul(rows, by)
        return found

    @cached_property
    def inverse_dynamics(self) -> str:
        """tau."""
        g, n, model = self.g, self.n, self.model
        moved = g.reshaped(g.MatMul(self.mass_matrix, g.reshaped("qdd", 0, n, 1)), 0, n)
        force, inputs = g.total([moved, *self._loads]), model.inputs + np.diag(1 - model.actuated)
        if not np.array_equal(inputs, np.eye(n)):
            force = g.MatMul(force, np.linalg.inv(inputs).T)
        found: str = g.Add(force, model.torque_offset) if model.torque_offset.any() else force
        return found

    @cached_property
    def forward_dynamics(self) -> str:
        """qdd."""
        g, n, model = self.g, self.n, self.model
        tau = self._turned("tau", model.inputs.T)
        offset = [g.constant(model.inputs @ model.torque_offset)] if model.torque_offset.any() else []
        force = g.Sub(tau, g.total([*self._loads, *offset]))
        inverse = g.inverse(self.mass_matrix, n)
        return g.reshaped(g.MatMul(inverse, g.reshaped(force, 0, n, 1)), 0, n)

    @cached_property
    def _loads(self) -> list[str]:
        """Parts, (batch, n), of what drives hold up beside accelerations."""
        compensation = self.model.friction_compensation
        drives = [self.g.Mul("qd", -compensation)] if compensation.any() else []
        return [*self._bias, self.friction, *drives]
