"""What friction takes, as CasADi expressions, and what its memory does along a displacement."""

from __future__ import annotations

import casadi as ca

from spelgen.exporting.description import Bristles, FrictionLaw


def law_torque(law: FrictionLaw, qd: ca.SX, gravity: ca.SX, direction: ca.SX) -> ca.SX:
    """``runtime.friction_laws``: (n, 1) [Nm, N], under this gravity torque; direction: of dry friction, -1 to 1."""
    dry = ca.SX(law.coulomb) + law.load_dependence * ca.fabs(gravity)
    if law.stribeck.any():
        dry = dry + law.stribeck * ca.exp(-((qd / law.stribeck_velocity) ** 2))
    return law.viscous * qd + law.saturation * ca.tanh(qd / law.saturation_velocity) + dry * direction


def sliding_direction(law: FrictionLaw, qd: ca.SX) -> ca.SX:
    """The direction of dry friction of joints that have long gone this way, (n, 1)."""
    return ca.tanh(qd / law.coulomb_smoothing_velocity)


def bristle_direction(bristles: Bristles, z: ca.SX) -> ca.SX:
    """fraction z / reach, summed over a joint's elements; (n, 1). z: joint by joint, (n count, 1)."""
    n, count = bristles.reach.shape
    bent = z * (bristles.fractions / bristles.reach).ravel()
    return ca.sum2(ca.reshape(bent, count, n).T)


def sliding_bristles(bristles: Bristles, law: FrictionLaw, qd: ca.SX) -> ca.SX:
    """z of joints that have long gone this way, (n count, 1)."""
    direction = _by_element(bristles, sliding_direction(law, qd))
    return direction * bristles.reach.ravel()


def bristle_step(bristles: Bristles, z: ca.SX, dq: ca.SX) -> ca.SX:
    """z after a displacement dq: z' = qd - |qd| z / reach, solved along it."""
    moved = _by_element(bristles, dq)
    reach = bristles.reach.ravel()
    end = ca.sign(moved) * reach
    return end + (z - end) * ca.exp(-ca.fabs(moved) / reach)


def _by_element(bristles: Bristles, values: ca.SX) -> ca.SX:
    """A joint's value for each of its elements, (n count, 1)."""
    return ca.vec(ca.repmat(values.T, bristles.count, 1))
