"""The constraint from the coordinates of an arm to the joints of its bodies; it needs no Pinocchio."""

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.constraint import Constraint


def body_constraint(arm: Chain) -> Constraint:
    """Return the constraint from the coordinates of the arm to the joints of all bodies, mimic joints included."""
    jacobian = np.zeros((len(arm.bodies), len(arm.coordinates)))
    for row, body in enumerate(arm.bodies):
        jacobian[row, body.coordinate] = float(body.multiplier)
    offset = np.array([body.offset for body in arm.bodies], dtype=float)
    return Constraint(tuple(body.name for body in arm.bodies), jacobian, offset)
