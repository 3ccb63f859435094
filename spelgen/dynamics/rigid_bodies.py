"""Rigid bodies of any inertial parameters, possible or not, over many states at once.

Spatial vectors, (angular, linear), are rows in the bodies' own frames (Featherstone, Rigid Body Dynamics Algorithms,
2008).
"""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm, Body

_AXES = np.eye(3)
_SKEW = np.cross(_AXES[:, None], _AXES[None]).transpose(0, 2, 1)  # _SKEW[k] b = e_k x b


def _turn_tables() -> np.ndarray:
    """Rotations about z are tables[0] + cos tables[1] + sin tables[2], (3, 3, 3)."""
    about = np.zeros((3, 3, 3))
    about[0, 2, 2] = about[1, 0, 0] = about[1, 1, 1] = about[2, 1, 0] = 1
    about[2, 0, 1] = -1
    return about


class RigidBodies:
    """The bodies of an arm with these inertial parameters, (10 B,), in the order of ``regressor``."""

    def __init__(self, arm: Arm, parameters: np.ndarray) -> None:
        self.parents = [body.parent for body in arm.bodies]
        self.revolute = np.array([body.kind == "revolute" for body in arm.bodies])
        self.ratios = np.zeros((len(arm.bodies), len(arm.coordinates)))
        for row, body in zip(self.ratios, arm.bodies, strict=True):
            row[body.coordinate] = float(body.multiplier)
        self.offsets = np.array([body.offset for body in arm.bodies])
        self.axes = np.eye(6)[np.where(self.revolute, 2, 5)]  # (B, 6)
        self.turning = np.array([_turning(axis) for axis in self.axes])  # (B, 6, 6)
        self.maps = np.array([_twist_maps(body) for body in arm.bodies]).transpose(1, 0, 2, 3)  # (3, B, 6, 6)
        self.inertia = np.array([_inertia(ten) for ten in parameters.reshape(-1, 10)])  # (B, 6, 6)
        self.base = np.array([0.0, 0.0, 0.0, *(-float(x) for x in arm.gravity)])

    def mass_and_bias(self, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M, (T, n, n), and Coriolis, centrifugal and gravity torques, (T, n) [Nm, N], at q and qd, (T, n)."""
        count, n = q.shape
        value, speed = q @ self.ratios.T + self.offsets, qd @ self.ratios.T  # (T, B)
        first = np.where(self.revolute, np.cos(value), value)[..., None, None]
        second = np.where(self.revolute, np.sin(value), 0.0)[..., None, None]
        maps = self.maps[0] + first * self.maps[1] + second * self.maps[2]  # (T, B, 6, 6), of rows
        rows: list[
            np.ndarray
        ] = []  # of each body: its twists by joint velocity, and its acceleration at steady qd
        base = np.broadcast_to(np.concatenate([np.zeros((n, 6)), self.base[None]]), (count, n + 1, 6))
        for index, parent in enumerate(self.parents):
            own = (base if parent < 0 else rows[parent]) @ maps[:, index]
            own[:, :n] += self.ratios[index][:, None] * self.axes[index]
            twist = (qd[:, None] @ own[:, :n])[:, 0]
            own[:, n] += speed[:, index, None] * (twist @ self.turning[index])
            rows.append(own)
        moved = np.stack(rows, axis=1)  # (T, B, n + 1, 6)
        twists = moved[:, :, :n]
        velocity = (qd[:, None, None] @ twists)[:, :, 0]  # (T, B, 6)
        momentum = (velocity[:, :, None] @ self.inertia)[:, :, 0]
        loads = moved @ self.inertia
        wrench = loads[:, :, n] + _carried(velocity, momentum)
        flat = twists.transpose(0, 2, 1, 3).reshape(count, n, -1)  # (T, n, 6 B)
        mass = flat @ loads[:, :, :n].transpose(0, 2, 1, 3).reshape(count, n, -1).transpose(0, 2, 1)
        return mass, (flat @ wrench.reshape(count, -1, 1))[..., 0]


def _twist_maps(body: Body) -> np.ndarray:
    """Twists in the parent's frame, as rows, times maps[0] + c maps[1] + s maps[2] are those in the body's, (3, 6, 6).

    c and s: cos and sin of its angle; of a sliding body its displacement and 0.
    """
    pose = np.array([[float(x) for x in row] for row in body.rotation])
    position = np.array([float(x) for x in body.translation])
    maps = np.zeros((3, 6, 6))
    if body.kind == "revolute":
        for found, turn in zip(maps, _turn_tables(), strict=True):
            found[:] = _row_map(pose @ turn, position)
    else:
        maps[0] = _row_map(pose, position)
        maps[1] = _row_map(pose, position + pose[:, 2]) - maps[0]
    return maps


def _row_map(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(angular, linear) R and linear + angular x position, as rows times one matrix, (6, 6)."""
    crossed = np.tensordot(position, _SKEW, axes=1)  # p x; angular x p = angular @ (p x)
    return np.block([[rotation, crossed @ rotation], [np.zeros((3, 3)), rotation]])


def _inertia(ten: np.ndarray) -> np.ndarray:
    """The spatial inertia, (6, 6), symmetric: rows of twists times it are momenta (angular, linear)."""
    mass, first = ten[0], np.tensordot(ten[1:4], _SKEW, axes=1)
    xx, xy, xz, yy, yz, zz = ten[4:]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.block([[tensor, first], [-first, mass * np.eye(3)]])


def _turning(axis: np.ndarray) -> np.ndarray:
    """Twists, as rows, times this (6, 6) are twist x axis."""
    angular, linear = (np.tensordot(half, _SKEW, axes=1) for half in (axis[:3], axis[3:]))
    return np.block([[angular, linear], [np.zeros((3, 3)), angular]])


def _carried(velocity: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """What a momentum that moves along with the body needs, v x* h, (T, B, 6)."""
    spin, along = velocity[..., :3], velocity[..., 3:]
    turning, pushing = momentum[..., :3], momentum[..., 3:]
    return np.concatenate(
        [_crossed(spin, turning) + _crossed(along, pushing), _crossed(spin, pushing)], axis=-1
    )


def _crossed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b, (T, B, 3): `np.cross` takes several times as long over vectors of any kind."""
    following, last = [1, 2, 0], [2, 0, 1]
    crossed: np.ndarray = a[..., following] * b[..., last] - a[..., last] * b[..., following]
    return crossed
