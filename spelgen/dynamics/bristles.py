"""The friction state z along a measured path: deflections of the bristles at every sample, in one pass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.design import BREAKAWAY
from spelgen.dynamics.protocol import motors_of
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


@dataclass(frozen=True, eq=False)
class BristleReach:
    """Break-away displacements of the bristles of all drives: values, (n, K) [rad, m]; K is 0 without bristles.

    motors: C, (n, n), the drives rotate at C qd (see ``Actuation.motor_speeds``); None: each drive moves its own joint.
    smoothing_velocity: of dry friction without bristles, (n,) [rad/s, m/s]; None: unknown.
    """

    values: np.ndarray
    motors: np.ndarray | None = None
    smoothing_velocity: np.ndarray | None = None

    @property
    def elements(self) -> int:
        """Bristles per joint, K."""
        return int(self.values.shape[1])


def reach_of(kinds: Sequence[str], motors: np.ndarray | None = None) -> BristleReach:
    """Return the typical break-away displacements, (n, K) [rad, m], of joints of these types; motors: C, (n, n)."""
    return BristleReach(np.array([BREAKAWAY[kind] for kind in kinds]), motors)


def bristle_reach(model: PortHamiltonian) -> BristleReach:
    """Return the break-away displacements of a model."""
    if not isinstance(model, RigidBodyDynamics) or not model.elements:
        return BristleReach(np.zeros((model.n, 0)))
    width = model.friction.prepare().coulomb_smoothing_velocity
    tensors = (model.friction.reach, motors_of(model), width)
    # paths are computed by NumPy in double precision, for a model on any device
    arrays = [x.detach().cpu().double().numpy() for x in tensors]
    return BristleReach(*arrays)


def moved_bristles(z: torch.Tensor, displacement: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
    """Return the deflections after a monotonic displacement of the drives, exactly.

    Args:
        z: (..., n, K) deflections of the bristles [rad, m].
        displacement: (..., n, 1) displacement of the drives [rad, m].
        reach: (n, K) break-away displacements [rad, m].
    """
    return (z + displacement).clamp(-reach, reach)


def bristles_along(q: np.ndarray, bristles: BristleReach) -> np.ndarray:
    """Return z, (T, n, K) [rad, m], along the path q (T, n) [rad, m]; z is zero at its start.

    Between two reversals of a drive, z is a function of the displacement since the first, so that only the reversals
    are computed one after the other.
    """
    path = encoded(q)
    if bristles.motors is not None:
        path = path @ bristles.motors.T
    corners, latest = turning_points(path)
    drives, reach = np.arange(path.shape[1]), torch.from_numpy(bristles.values)
    turned_at = np.take_along_axis(path, corners, axis=0)
    at_corners = [torch.zeros_like(reach)]
    # Only reversals are sequential, and they are few: given z at the last reversal, samples are independent.
    for displacement in torch.from_numpy(np.diff(turned_at, axis=0)):
        at_corners.append(moved_bristles(at_corners[-1], displacement[:, None], reach))
    turned_with, z = torch.stack(at_corners), np.empty((*q.shape, bristles.elements))
    size = 2**14  # samples that are computed at a time: several arrays of this size are in memory
    for start in range(0, len(q), size):
        block = slice(start, start + size)
        corner = latest[block], drives
        moved = torch.from_numpy(path[block] - turned_at[corner])
        z[block] = moved_bristles(turned_with[corner], moved[..., None], reach).numpy()
    return z


def turning_points(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples (R, n) at which the columns of a path (T, n) begin and reverse.

    The second array is the index of the latest reversal at each sample, (T, n).
    """
    steps = np.diff(path, axis=0, prepend=path[:1])
    # at rest, the direction of the last motion remains
    moving = np.where(steps != 0, np.arange(len(path))[:, None], 0)
    # a running maximum of indices is the latest sample that moved
    direction = np.sign(np.take_along_axis(steps, np.maximum.accumulate(moving, axis=0), axis=0))
    turns = np.zeros(path.shape, dtype=bool)
    turns[1:] = direction[1:] * direction[:-1] < 0
    latest = turns.cumsum(axis=0)
    # drives with fewer reversals than others have zeros at the end, which no sample refers to
    corners = np.zeros((latest.max(initial=0) + 1, path.shape[1]), dtype=int)
    samples, drives = np.nonzero(turns)
    corners[latest[samples, drives], drives] = samples - 1
    return corners, latest


def direction_along(qd: np.ndarray, bristles: BristleReach) -> np.ndarray | None:
    """Return the direction (T, n) of dry friction without bristles at qd (T, n); None: its smoothing is unknown."""
    if bristles.smoothing_velocity is None:
        return None
    # the same smooth sign as in `runtime.friction_laws`: another would be an error of friction
    speed = qd if bristles.motors is None else qd @ bristles.motors.T
    return np.asarray(speed / np.hypot(speed, bristles.smoothing_velocity))


def encoded(q: np.ndarray) -> np.ndarray:
    """Return the path (T, n) without jitter of the encoder: a dead band of one encoder step to both sides."""
    step = encoder_step(q)
    if not step.any():
        return q
    # the composition of two clamps is a clamp: log2(T) passes over all samples in place of T
    # Backlash of one step: the output follows the input only beyond it, out[k] = clip(out[k-1], low[k], high[k]).
    low, high = q - step, q + step
    shift = 1
    while shift < len(q):
        earlier, later = slice(None, -shift), slice(shift, None)
        clamped = [np.clip(x[earlier], low[later], high[later]) for x in (low, high)]
        low[later], high[later] = clamped
        shift *= 2
    return np.asarray(np.clip(np.broadcast_to(q[:1], q.shape), low, high))


def encoder_step(q: np.ndarray) -> np.ndarray:
    """Return the encoder step (n,) of positions (T, n); 0 if they are not quantised."""
    steps = np.zeros(q.shape[1])
    for joint, values in enumerate(q.T):
        # Floating-point positions do not repeat; steps of an encoder do.
        levels = np.unique(values)
        if len(levels) > 1 and len(levels) < len(values) / 4:  # repeated values
            steps[joint] = np.diff(levels).min()
    return steps
