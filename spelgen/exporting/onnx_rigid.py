"""Rigid bodies as an ONNX graph: twists of all bodies side by side, as in ``runtime.rigid_body_dynamics``."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph
from spelgen.runtime.rigid_body import Bodies, inertia_basis, transform_table


class OnnxRigid:
    """M, bias and gravity of the bodies at q, (batch, n); armature is not among them."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        self.g, self.n, self._q = graph, model.n, q
        self._bodies, self.b = model.bodies, len(model.bodies)
        tables = [transform_table(_geometry(model), index).mT.numpy() for index in range(self.b)]
        self._tables = np.stack(tables).reshape(self.b, 3, 36)
        basis = inertia_basis().numpy()
        self._inertia = np.zeros((6 * self.b, 6 * self.b))
        for k, ten in enumerate(model.inertias):
            self._inertia[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = np.tensordot(ten, basis, axes=1)
        self._axes, self._ratios = np.zeros((self.n, 6 * self.b)), np.zeros((self.b, self.n))
        for k, body in enumerate(self._bodies):
            self._ratios[k, body.coordinate] = float(body.multiplier)
            own = 6 * k + (2 if body.kind == "revolute" else 5)
            self._axes[body.coordinate, own] = float(body.multiplier)
        self._weight = np.array([0, 0, 0, *(-model.gravity)])

    @cached_property
    def _transforms(self) -> list[str]:
        """By body, what takes rows from the parent's frame, (batch, 6, 6)."""
        g, offsets = self.g, np.array([body.offset for body in self._bodies])
        value = self._q
        if not np.array_equal(self._ratios, np.eye(self.n)) or offsets.any():
            value = g.Add(g.MatMul(self._q, self._ratios.T), offsets)
        turning = np.array([float(body.kind == "revolute") for body in self._bodies])
        cosine, sine = g.Cos(value), g.Sin(value)
        if not turning.all():  # a sliding body's table goes with its displacement
            cosine = g.Add(g.Mul(turning, cosine), g.Mul(1 - turning, value))
        by_cos = g.Mul(g.reshaped(cosine, 0, self.b, 1), self._tables[:, 1])
        by_sin = g.Mul(g.reshaped(sine, 0, self.b, 1), self._tables[:, 2])
        whole = g.Add(g.Add(by_cos, by_sin), self._tables[:, 0])
        parts: list[str] = g.split(g.reshaped(whole, 0, 6 * self.b, 6), [6] * self.b, 1)
        return parts

    @cached_property
    def _motion(self) -> tuple[str, str]:
        """Twists by joint velocity, (batch, n, 6 b), and what stands for gravity, (batch, 1, 6 b)."""
        g = self.g
        base = np.vstack([np.zeros((self.n, 6)), self._weight])[None]
        own = np.vstack([self._axes, np.zeros((1, 6 * self.b))])
        moved: list[str] = []
        for k, body in enumerate(self._bodies):
            below = base if body.parent < 0 else moved[body.parent]
            moved.append(g.Add(g.MatMul(below, self._transforms[k]), own[:, 6 * k : 6 * k + 6]))
        columns = moved[0] if self.b == 1 else g.Concat(*moved, axis=2)
        twists, weight = g.split(columns, [self.n, 1], 1)
        return twists, weight

    @cached_property
    def _back(self) -> str:
        """Twists by joint velocity, transposed, (batch, 6 b, n)."""
        found: str = self.g.Transpose(self._motion[0], perm=[0, 2, 1])
        return found

    @cached_property
    def mass(self) -> str:
        """(batch, n, n)."""
        found: str = self.g.MatMul(self.g.MatMul(self._motion[0], self._inertia), self._back)
        return found

    @cached_property
    def gravity(self) -> str:
        """(batch, 1, n)."""
        found: str = self.g.MatMul(self.g.MatMul(self._motion[1], self._inertia), self._back)
        return found

    def bias(self, qd: str) -> str:
        """(batch, 1, n); qd: (batch, 1, n)."""
        g, b = self.g, self.b
        turning, crossing = np.zeros((6 * b, 6 * b)), _crossing()
        for k, axis in enumerate(self._axes.sum(axis=0).reshape(b, 6)):
            turning[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = (crossing @ axis[:, None])[..., 0]
        twists = g.MatMul(qd, self._motion[0])
        owner = np.repeat((self._ratios != 0).astype(float), 6, axis=0)
        own = g.split(g.Mul(g.MatMul(twists, turning), g.MatMul(qd, owner.T)), [6] * b, 2)
        rises: list[str] = []
        for k, body in enumerate(self._bodies):
            below = [] if body.parent < 0 else [g.MatMul(rises[body.parent], self._transforms[k])]
            rises.append(g.Add(own[k], below[0]) if below else own[k])
        rise = g.Add(rises[0] if b == 1 else g.Concat(*rises, axis=2), self._motion[1])
        cross = g.reshaped(g.MatMul(g.reshaped(twists, 0, b, 6), crossing.reshape(6, 36)), 0, b, 6, 6)
        momenta = g.reshaped(g.MatMul(twists, self._inertia), 0, b, 1, 6)
        turned = g.reshaped(g.MatMul(momenta, cross), 0, 1, 6 * b)
        found: str = g.MatMul(g.Sub(g.MatMul(rise, self._inertia), turned), self._back)
        return found


def _crossing() -> np.ndarray:
    """What a frame with each unit twist makes of a constant twist in it, (6, 6, 6); rows as in the runtime."""
    found = np.zeros((6, 6, 6))
    for axis, unit in enumerate(np.eye(3)):
        x, y, z = unit
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        found[axis, :3, :3] = found[axis, 3:, 3:] = skew
        found[3 + axis, 3:, :3] = skew
    return found


def _geometry(model: TrainedModel) -> Bodies:
    """The bodies as the runtime has them, without inertias."""
    rotations = [np.array(body.rotation, dtype=float).tolist() for body in model.bodies]
    return Bodies(
        parent=tuple(body.parent for body in model.bodies),
        joint=tuple(body.coordinate for body in model.bodies),
        revolute=tuple(body.kind == "revolute" for body in model.bodies),
        ratio=tuple(float(body.multiplier) for body in model.bodies),
        offset=tuple(body.offset for body in model.bodies),
        rotation=tuple(rotations),
        position=tuple(tuple(float(x) for x in body.translation) for body in model.bodies),  # type: ignore[misc]
        mass=(),
        moment=(),
        inertia=(),
        products=(),
    )
