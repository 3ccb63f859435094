"""The memory of friction along a measured path: the state z of its bristles at every sample, in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.design import BRISTLE_REACH
from spelgen.dynamics.protocol import motors_of
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


@dataclass(frozen=True, eq=False)
class BristleReach:
    """How far the bristles of an arm's drives reach: values, (n, K) [rad, m]; K is 0 where there are none.

    motors: C, (n, n), the drives turn by C times what the joints do (see ``Actuation.motor_speeds``); None: each moves
    its own joint alone. smoothing_velocity: (n,) [rad/s, m/s], over which dry friction without memory turns around.
    """

    values: np.ndarray
    motors: np.ndarray | None = None
    smoothing_velocity: np.ndarray | None = None

    @property
    def elements(self) -> int:
        """K."""
        return int(self.values.shape[1])


NO_BRISTLES = BristleReach(np.zeros((0, 0)))
BLOCK = 2**14  # samples moved at a time: several arrays of a block's size are in memory


def reach_of(kinds: Sequence[str], motors: np.ndarray | None = None) -> BristleReach:
    """Of joints of these kinds."""
    return BristleReach(np.array([BRISTLE_REACH[kind] for kind in kinds]), motors)


def bristle_reach(model: PortHamiltonian) -> BristleReach:
    """Of a model."""
    if not isinstance(model, RigidBodyDynamics) or not model.elements:
        return BristleReach(np.zeros((model.n, 0)))
    width = model.friction.prepare().coulomb_smoothing_velocity
    tensors = (model.friction.reach, motors_of(model), width)
    arrays = [x.detach().cpu().double().numpy() for x in tensors]
    return BristleReach(*arrays)


def moved_bristles(z: torch.Tensor, displacement: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
    """Return z after drives went one way by a displacement, exactly; shapes as z, or broadcast to it."""
    return (z + displacement).clamp(-reach, reach)


def bristles_along(q: np.ndarray, bristles: BristleReach) -> np.ndarray:
    """z, (T, n, K) [rad, m], along the path q (T, n), straight at its start.

    While a drive goes one way, z follows from where it turned around: only turns come one after another.
    """
    path = encoded(q)
    if bristles.motors is not None:
        path = path @ bristles.motors.T
    corners, latest = turning_points(path)
    drives, reach = np.arange(path.shape[1]), torch.from_numpy(bristles.values)
    turned_at = np.take_along_axis(path, corners, axis=0)
    at_corners = [torch.zeros_like(reach)]
    for way in torch.from_numpy(np.diff(turned_at, axis=0)):
        at_corners.append(moved_bristles(at_corners[-1], way[:, None], reach))
    turned_with, z = torch.stack(at_corners), np.empty((*q.shape, bristles.elements))
    for start in range(0, len(q), BLOCK):
        block = slice(start, start + BLOCK)
        corner = latest[block], drives
        moved = torch.from_numpy(path[block] - turned_at[corner])
        z[block] = moved_bristles(turned_with[corner], moved[..., None], reach).numpy()
    return z


def turning_points(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples (R, n) at which the columns of a path (T, n) begin and turn around.

    The second array says which of these is the latest, (T, n), at each sample.
    """
    steps = np.diff(path, axis=0, prepend=path[:1])
    # where a drive stands still it goes on as it went
    moving = np.where(steps != 0, np.arange(len(path))[:, None], 0)
    direction = np.sign(np.take_along_axis(steps, np.maximum.accumulate(moving, axis=0), axis=0))
    turns = np.zeros(path.shape, dtype=bool)
    turns[1:] = direction[1:] * direction[:-1] < 0
    latest = turns.cumsum(axis=0)
    # drives that turn around less often than others have zeros at the end, which are the latest of no sample
    corners = np.zeros((latest.max(initial=0) + 1, path.shape[1]), dtype=int)
    samples, drives = np.nonzero(turns)
    corners[latest[samples, drives], drives] = samples - 1
    return corners, latest


def direction_along(qd: np.ndarray, bristles: BristleReach) -> np.ndarray | None:
    """Return the direction (T, n) of dry friction without memory at these velocities; None: its width is not known."""
    if bristles.smoothing_velocity is None:
        return None
    speed = qd if bristles.motors is None else qd @ bristles.motors.T
    return np.asarray(speed / np.hypot(speed, bristles.smoothing_velocity))


def encoded(q: np.ndarray) -> np.ndarray:
    """The path (T, n) without the jitter of encoders: it follows q out of a band of a step to both sides."""
    step = encoder_step(q)
    if not step.any():
        return q
    low, high = q - step, q + step  # clamping to a band after a band is clamping to one
    shift = 1
    while shift < len(q):
        earlier, later = slice(None, -shift), slice(shift, None)
        clamped = [np.clip(x[earlier], low[later], high[later]) for x in (low, high)]
        low[later], high[later] = clamped
        shift *= 2
    return np.asarray(np.clip(np.broadcast_to(q[:1], q.shape), low, high))


def encoder_step(q: np.ndarray) -> np.ndarray:
    """The step (n,) in which positions (T, n) come; 0 where they come in none."""
    steps = np.zeros(q.shape[1])
    for joint, values in enumerate(q.T):
        levels = np.unique(values)
        if len(levels) > 1 and len(levels) < len(values) / 4:  # values that come again and again
            steps[joint] = np.diff(levels).min()
    return steps
