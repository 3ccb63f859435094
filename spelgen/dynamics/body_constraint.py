"""Joint positions of all bodies, mimic joints included, as a linear function of the coordinates q of an arm."""

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.constraint import Constraint


def body_constraint(arm: Chain) -> Constraint:
    """Return the joint positions of all bodies, (bodies,) [rad, m], as a function K q + offset of q, (n,) [rad, m]."""
    jacobian = np.zeros((len(arm.bodies), len(arm.coordinates)))
    for row, body in enumerate(arm.bodies):
        jacobian[row, body.coordinate] = float(body.multiplier)
    offset = np.array([body.offset for body in arm.bodies], dtype=float)
    return Constraint(tuple(body.name for body in arm.bodies), jacobian, offset)
