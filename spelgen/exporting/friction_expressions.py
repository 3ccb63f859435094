"""Friction as CasADi expressions: the laws of ``runtime.friction_laws``, and the bristles that are its memory."""

from __future__ import annotations

import casadi as ca

from spelgen.exporting.description import Bristles, FrictionLaw


def law_torque(law: FrictionLaw, qd: ca.SX, gravity: ca.SX, direction: ca.SX) -> ca.SX:
    """Return the torque of friction, (n, 1) [Nm, N], under this gravity torque.

    direction: of dry friction, from -1 to 1.
    """
    load = ca.sqrt(gravity**2 + law.least_load**2)
    dry = law.coulomb + law.load_dependence * load
    # CasADi would not see that zero times an exponential is zero
    if law.stribeck.any():
        fading = ca.exp(-((qd / law.stribeck_velocity) ** 2))
        dry = dry + law.stribeck * fading
    viscous = law.viscous * qd
    saturating = law.saturation * ca.tanh(qd / law.saturation_velocity)
    torque: ca.SX = viscous + saturating + dry * direction
    return torque


def sliding_direction(law: FrictionLaw, qd: ca.SX) -> ca.SX:
    """Return the direction of dry friction of joints that slide at qd for long, (n, 1)."""
    return ca.tanh(qd / law.coulomb_smoothing_velocity)


def bristle_direction(bristles: Bristles, z: ca.SX) -> ca.SX:
    """Return the sum of fraction z / reach over a joint's elements, (n, 1); z: joint by joint, (n K, 1)."""
    n, count = bristles.reach.shape
    stiffness = bristles.fractions / bristles.reach
    bent = z * stiffness.ravel()
    # CasADi reshapes column by column: a joint's elements are a column
    result: ca.SX = ca.sum1(ca.reshape(bent, count, n)).T
    return result


def sliding_bristles(bristles: Bristles, law: FrictionLaw, qd: ca.SX) -> ca.SX:
    """Return z of joints that slide at qd for long, (n K, 1)."""
    z: ca.SX = _by_element(bristles, sliding_direction(law, qd)) * bristles.reach.ravel()
    return z


def bristle_step(bristles: Bristles, z: ca.SX, dq: ca.SX) -> ca.SX:
    """Return z after a displacement dq: the solution of z' = qd - |qd| z / reach along it."""
    moved = _by_element(bristles, dq)
    reach = bristles.reach.ravel()
    end = ca.sign(moved) * reach
    z_next: ca.SX = z + (z - end) * ca.expm1(-ca.fabs(moved) / reach)
    return z_next


def _by_element(bristles: Bristles, values: ca.SX) -> ca.SX:
    """Return a joint's value for each of its elements, (n K, 1)."""
    return ca.vec(ca.repmat(values.T, bristles.count, 1))
