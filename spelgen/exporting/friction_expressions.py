"""Friction as CasADi expressions: the laws of ``runtime.friction_laws``, and the bristles that are its memory."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np


def law_torque(law: Any, qd: ca.SX, gravity: ca.SX, direction: ca.SX) -> ca.SX:
    """Return the torque of friction, (n, 1) [Nm, N], under this gravity torque.

    law: ``FrictionConstants`` of arrays. direction: of dry friction, from -1 to 1.
    """
    load = ca.sqrt(gravity**2 + law.least_load**2)
    dry = law.coulomb + law.load_dependence * load
    speed = ca.fabs(qd) / law.stribeck_velocity
    rounding = law.stribeck_rounding
    slow = 1 / (1 + (1 + rounding) / 8 * speed**2 / (speed + rounding))
    for _ in range(3):  # to the power of 8
        slow = slow * slow
    dry += law.stribeck * slow
    torque: ca.SX = law.viscous * qd + law.saturation * turned(qd, law.saturation_velocity) + dry * direction
    return torque


def turned(velocity: ca.SX, width: np.ndarray) -> ca.SX:
    """Return a direction from -1 to 1 that turns around over this width of velocities, (n, 1)."""
    return velocity / ca.sqrt(velocity**2 + width**2)


def bristle_direction(fractions: np.ndarray, reach: np.ndarray, z: ca.SX) -> ca.SX:
    """Return the sum of fraction z / reach over a joint's elements, (n, 1); z: joint by joint, (n K, 1)."""
    n, count = reach.shape
    bent = z * (fractions / reach).ravel()
    # CasADi reshapes column by column: a joint's elements are a column
    direction: ca.SX = ca.sum1(ca.reshape(bent, count, n)).T
    return direction


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
