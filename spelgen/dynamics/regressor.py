"""The rigid-body regressor Y(q, qd, qdd) of an arm: the joint torques are Y times the bodies' inertial parameters."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.body_regressor import chain_regressor
from spelgen.dynamics.rigid_bodies import body_chain


def regressor(arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return Y (T, n, 10 B) of the arm's B bodies at q, qd, qdd, each (T, n): tau = Y pi [Nm, N].

    Column 10 b + i belongs to parameter i of ``arm.bodies[b]``, in the order of ``Body.inertia``.
    """
    return chain_regressor(body_chain(arm), q, qd, qdd)


def urdf_parameters(arm: Arm) -> np.ndarray:
    """The URDF's own inertial parameters, (10 B,); zero for a body without."""
    return np.array([body.inertia or (0,) * 10 for body in arm.bodies], dtype=float).ravel()
