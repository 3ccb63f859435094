"""Rigid bodies as an ONNX graph of few nodes, in the manner of ``runtime.body_chain``."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spelgen.exporting.description import TrainedModel
from spelgen.exporting.onnx_graph import OnnxGraph
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.rigid_body import Bodies, inertia_basis


class OnnxRigid:
    """M, bias and gravity of the bodies at q, (batch, n); armature is not among them."""

    def __init__(self, model: TrainedModel, graph: OnnxGraph, q: str) -> None:
        self.g, self.n, self._q, self.b = graph, model.n, q, len(model.bodies)
        x, y, z = (float(each) for each in model.gravity)
        chain = BodyChain(model.n, _geometry(model), (x, y, z))
        self._chain = {name: value.numpy() for name, value in chain.named_buffers()}
        self._single = chain.single
        self._turning = all(body.kind == "revolute" for body in model.bodies)
        basis = inertia_basis().numpy()
        self._inertia = np.zeros((6 * self.b, 6 * self.b))
        for k, ten in enumerate(model.inertias):
            self._inertia[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = np.tensordot(ten, basis, axes=1)
        self._blocks = np.repeat(np.eye(self.b), 6, axis=1)  # (b, 6 b)
        self._parents = [body.parent for body in model.bodies]

    @cached_property
    def _frames(self) -> str:
        """What takes twists from the base's frame to the bodies', (batch, 6, 6 b)."""
        g, table, ratios = self.g, self._chain["table"], self._chain["ratios"]
        features = g.waves(self._q, ratios)
        if not self._turning:
            features = g.Concat(features, g.MatMul(self._q, ratios.T), axis=1)
        used = table[:, : self.b * (2 if self._turning else 3)]
        whole = g.Gemm(features, used, self._chain["fixed"], transB=1)
        own = g.split(g.reshaped(whole, 0, 6 * self.b, 6), [6] * self.b, 1)
        placed: list[str] = []
        for k, parent in enumerate(self._parents):
            placed.append(own[k] if parent < 0 else g.MatMul(placed[parent], own[k]))
        found: str = placed[0] if self.b == 1 else g.Concat(*placed, axis=2)
        return found

    @cached_property
    def _axes(self) -> list[str]:
        """The bodies' axes in the base's frame, (batch, b, 6), and what products take of them, (batch, b, 18)."""
        g, swap = self.g, np.roll(np.eye(6), 3, axis=0)
        # the left factors are those of twists, which are sums of axes; of forces the axes feel the products
        table = np.concatenate([np.eye(6), _LEFT, _MOTION_RIGHT, _FORCE_SUMS.T]) @ swap
        axes = g.MatMul(self._chain["reading"].T[None], g.Transpose(self._frames, perm=[0, 2, 1]))
        return g.split(g.MatMul(axes, table.T), [6, 18, 18, 18], 2)

    @cached_property
    def _twists(self) -> str:
        """By joint velocity, (batch, n, 6 b)."""
        g = self.g
        bodies = g.Mul(g.MatMul(self._axes[0], self._frames), self._chain["carried"])
        found: str = bodies if self._single else g.MatMul(self._chain["ratios"].T[None], bodies)
        return found

    @cached_property
    def _momenta(self) -> str:
        """Of these twists, (batch, n, 6 b)."""
        found: str = self.g.MatMul(self._twists, self._inertia)
        return found

    @cached_property
    def mass(self) -> str:
        """(batch, n, n)."""
        found: str = self.g.MatMul(self._momenta, self.g.Transpose(self._twists, perm=[0, 2, 1]))
        return found

    def _felt(self, accelerations: str) -> str:
        """The torques, (batch, 1, n), of bodies with these accelerations, (batch, 1, 6 b)."""
        found: str = self.g.MatMul(accelerations, self.g.Transpose(self._momenta, perm=[0, 2, 1]))
        return found

    @cached_property
    def gravity(self) -> str:
        """(batch, 1, n)."""
        return self._felt(self.g.MatMul(self._chain["base"][None, None], self._frames))

    def coriolis(self, qd: str) -> tuple[str, str]:
        """Its parts, (batch, 1, n) and (batch, n); qd: (batch, n)."""
        g, ratios = self.g, self._chain["ratios"]
        row, (_, lefts, rights, felt) = g.reshaped(qd, 0, 1, self.n), self._axes
        by_bodies = row if self._single else g.MatMul(row, ratios.T)
        summed = g.Mul(
            by_bodies, self._chain["carriers"].T
        )  # of all that carries a body, at their velocities
        left = g.MatMul(summed, lefts)
        steady = g.MatMul(summed, g.MatMul(g.Mul(left, rights), _MOTION_SUMS.T))
        whole = g.Mul(g.MatMul(steady, self._frames), self._blocks)
        rising = self._felt(g.MatMul(np.ones((1, 1, self.b)), whole))
        momenta = g.Transpose(g.Mul(self._frames, g.MatMul(row, self._momenta)), perm=[0, 2, 1])
        pushed = g.Mul(left, g.MatMul(g.MatMul(self._blocks[None], momenta), _FORCE_RIGHT.T))
        products = g.Mul(felt, g.MatMul(self._chain["carriers"][None], pushed))
        held = g.ReduceSum(products, np.array([2]), keepdims=0)
        return rising, held if self._single else g.MatMul(held, ratios)


def _factors(components: tuple[int, ...], halves: tuple[int, int, int]) -> np.ndarray:
    """Takes the components that three cross products multiply from halves of a spatial vector, (18, 6)."""
    rows = [half + component for half in halves for component in components]
    chosen: np.ndarray = np.eye(6)[rows]
    return chosen


def _sums(*halves: int) -> np.ndarray:
    """Adds the products of three cross products to halves of a spatial vector, (6, 18)."""
    found = np.zeros((6, 18))
    for product, half in enumerate(halves):
        for k in range(6):
            found[half + k // 2, 6 * product + k] = (-1) ** k
    return found


# by a twist (w, u) a motion vector (a, m) changes by (w x a, w x m + u x a), a force vector (n, f) by
# (w x n + u x f, w x f): of each component two products, the second one negative
_FIRST, _SECOND = (1, 2, 2, 0, 0, 1), (2, 1, 0, 2, 1, 0)
_LEFT = _factors(_FIRST, (0, 0, 3))
_MOTION_RIGHT, _MOTION_SUMS = _factors(_SECOND, (0, 3, 0)), _sums(0, 3, 3)
_FORCE_RIGHT, _FORCE_SUMS = _factors(_SECOND, (0, 3, 3)), _sums(0, 3, 0)


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
