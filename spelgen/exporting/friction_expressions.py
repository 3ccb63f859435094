"""Friction as CasADi expressions: the laws of ``runtime.friction_laws``, and the bristles that are its memory."""

from __future__ import annotations

import casadi as ca
import numpy as np

from spelgen.exporting.description import TrainedModel


def friction_torque(model: TrainedModel, qd: ca.SX, gravity: ca.SX, z: ca.SX) -> ca.SX:
    """Return the torque of friction of the drives at their speeds, (n, 1) [Nm, N], under this gravity torque.

    z: of the bristles, joint by joint, (n K, 1).
    """
    law = model.friction
    # CasADi reshapes column by column: a joint's elements are a column
    bent = ca.reshape(z * (law.bristle_fractions / model.reach).ravel(), model.reach.shape[1], model.n)
    # from -1 to 1: a joint's dry friction follows velocity or bristles
    direction = law.memoryless * _turned(qd, law.coulomb_smoothing_velocity) + ca.sum1(bent).T
    load = ca.sqrt(gravity**2 + law.min_load**2)
    speed = ca.fabs(qd) / law.stribeck_velocity
    rounding = law.stribeck_rounding
    slow = 1 / (1 + (1 + rounding) / 8 * speed**2 / (speed + rounding))
    for _ in range(3):  # to the power of 8
        slow = slow * slow
    dry = law.coulomb + law.load_dependence * load + law.stribeck * slow
    viscous = law.viscous * qd + law.saturation * _turned(qd, law.saturation_velocity)
    torque: ca.SX = viscous + dry * direction
    return torque


def _turned(velocity: ca.SX, width: np.ndarray) -> ca.SX:
    """Return a direction from -1 to 1 that turns around over this width of velocities, (n, 1)."""
    return velocity / ca.sqrt(velocity**2 + width**2)


def sliding_bristles(reach: np.ndarray, width: np.ndarray, qd: ca.SX) -> ca.SX:
    """Return z of joints that slide at qd for long, (n K, 1); dry friction turns around over this width."""
    z: ca.SX = _by_element(reach, ca.tanh(qd / width)) * reach.ravel()
    return z


def bristle_step(reach: np.ndarray, z: ca.SX, dq: ca.SX) -> ca.SX:
    """Return z after a displacement dq one way: bristles bend up to their reach."""
    limit = reach.ravel()
    z_next: ca.SX = ca.fmin(ca.fmax(z + _by_element(reach, dq), -limit), limit)
    return z_next


def _by_element(reach: np.ndarray, values: ca.SX) -> ca.SX:
    """Return a joint's value for each of its elements, (n K, 1)."""
    return ca.vec(ca.repmat(values.T, reach.shape[1], 1))
