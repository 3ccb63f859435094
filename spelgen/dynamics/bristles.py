"""Friction state z along measured positions: deflections of Maxwell-slip bristles at every sample."""

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
    """Break-away displacements of K bristles for each of n drives, from which a friction state is computed.

    A bristle is a Maxwell-slip element: elastic up to its break-away displacement, sliding beyond it.

    Attributes:
        values: break-away displacements, (n, K) [rad, m]; K is 0 without bristles.
        motors: matrix C, (n, n): the velocities of the drives are C qd (see ``Actuation.motor_speeds``); None: each
            drive moves its own joint.
        smoothing_velocity: velocity v_s of the smooth sign v / sqrt(v^2 + v_s^2), on which the dry friction of a drive
            without bristles depends, (n,) [rad/s, m/s]; None: unknown.
    """

    values: np.ndarray
    motors: np.ndarray | None = None
    smoothing_velocity: np.ndarray | None = None

    @property
    def elements(self) -> int:
        """Number of bristles per drive, K."""
        return int(self.values.shape[1])

    def of_drives(self, joints: np.ndarray) -> np.ndarray:
        """Return the positions of the drives, (..., n), from the positions ``joints`` of the joints, (..., n) [rad, m].

        They are C times ``joints``, with the matrix C = `motors`. Velocities of the drives are computed from joint
        velocities in the same way.
        """
        return joints if self.motors is None else joints @ self.motors.T


def reach_of(kinds: Sequence[str], motors: np.ndarray | None = None) -> BristleReach:
    """Return the break-away displacements of K bristles for each of n joints, (n, K) [rad, m], with the matrix C.

    The displacements are constants of the package per joint type (`BREAKAWAY`); they do not depend on C.

    kinds: type of each joint (revolute or prismatic), (n,). motors: matrix C, (n, n): the velocities of the drives are
    C qd; None: each drive moves its own joint.
    """
    return BristleReach(np.array([BREAKAWAY[kind] for kind in kinds]), motors)


def bristle_reach(model: PortHamiltonian) -> BristleReach:
    """Return the break-away displacements of the K bristles per drive of a trained model; K = 0 without bristles."""
    if not isinstance(model, RigidBodyDynamics) or not model.elements:
        return BristleReach(np.zeros((model.n, 0)))
    width = model.friction.prepare().coulomb_smoothing_velocity
    tensors = (model.friction.reach, motors_of(model), width)
    # The model's tensors are converted to NumPy arrays in double precision, the type of measured positions.
    arrays = [x.detach().cpu().double().numpy() for x in tensors]
    return BristleReach(*arrays)


def moved_bristles(z: torch.Tensor, displacement: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
    """Return the deflections of K bristles per drive after a displacement of the drives, (..., n, K) [rad, m].

    The result is exact if the displacement has no reversals. The dimension of the bristles may also be the first one of
    all arguments, (K, ..., n).

    Args:
        z: deflections before the displacement, (..., n, K) [rad, m].
        displacement: displacement of the drives, (..., n, 1) [rad, m].
        reach: break-away displacements, (n, K) [rad, m].
    """
    return (z + displacement).clamp(-reach, reach)


def bristles_along(q: np.ndarray, bristles: BristleReach) -> np.ndarray:
    """Return the friction state z, (T, n, K) [rad, m], along measured joint positions q, (T, n) [rad, m].

    z has the deflections of K bristles per drive, and is zero at the first sample. Encoder jitter is first removed from
    q. After a reversal of a drive, z depends only on z at this reversal and on the displacement since then: the loop is
    over reversals, not over samples.
    """
    path = bristles.of_drives(encoded(q))
    z = np.empty((*q.shape, bristles.elements))
    for drive, (positions, reach) in enumerate(zip(path.T, bristles.values, strict=True)):
        steps = np.diff(positions)
        # Samples of a drive at rest are ignored: a reversal is a change of sign between two steps that are not zero.
        moving = np.flatnonzero(steps)
        signs = np.sign(steps[moving])
        reversals = moving[1:][signs[1:] * signs[:-1] < 0]
        corners = np.concatenate([[0], reversals])
        at_corners = [np.zeros_like(reach)]
        for displacement in np.diff(positions[corners]):
            at_corners.append(np.clip(at_corners[-1] + displacement, -reach, reach))
        # Index in `corners` of the latest reversal before or at each sample.
        latest = np.searchsorted(corners, np.arange(len(q)), side="right") - 1
        moved = positions - positions[corners[latest]]
        z[:, drive] = np.clip(np.stack(at_corners)[latest] + moved[:, None], -reach, reach)
    return z


def direction_along(qd: np.ndarray, bristles: BristleReach) -> np.ndarray | None:
    """Return the smooth sign of the velocity of each drive, (T, n), at joint velocities qd, (T, n) [rad/s, m/s].

    The dry friction of a drive without bristles is proportional to the smooth sign, which is from -1 to 1. Return None
    if the smoothing velocity is unknown.
    """
    if bristles.smoothing_velocity is None:
        return None
    # The smooth sign must be equal to the smooth sign of `runtime.friction_laws`, which the trained model uses.
    speed = bristles.of_drives(qd)
    return np.asarray(speed / np.hypot(speed, bristles.smoothing_velocity))


def encoded(q: np.ndarray) -> np.ndarray:
    """Return the measured positions q, (T, n) [rad, m], without encoder jitter.

    Jitter between two adjacent encoder steps would count as a reversal of the drive at each sample. The result is
    constant until q differs from it by more than one encoder step, like the output of a gear with backlash.
    """
    step = encoder_step(q)
    if not step.any():
        return q
    # Backlash: out[k] = clip(out[k-1], low[k], high[k]), with low and high one encoder step below and above q[k].
    # Compositions of clips are clips, so a parallel scan needs log2(T) passes instead of T sequential steps.
    low, high = q - step, q + step
    shift = 1
    while shift < len(q):
        earlier, later = slice(None, -shift), slice(shift, None)
        clamped = [np.clip(x[earlier], low[later], high[later]) for x in (low, high)]
        low[later], high[later] = clamped
        shift *= 2
    return np.asarray(np.clip(np.broadcast_to(q[:1], q.shape), low, high))


def encoder_step(q: np.ndarray) -> np.ndarray:
    """Return the encoder step of each joint, (n,) [rad, m]; 0 for a joint whose positions are not quantised.

    q: measured positions, (T, n) [rad, m].
    """
    steps = np.zeros(q.shape[1])
    for joint, values in enumerate(q.T):
        # Positions of an encoder repeat exactly. A joint is regarded as quantised if each value occurs more than four
        # times on average.
        levels = np.unique(values)
        if len(levels) > 1 and len(levels) < len(values) / 4:
            steps[joint] = np.diff(levels).min()
    return steps
