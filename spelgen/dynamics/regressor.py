"""The rigid-body regressor Y(q, qd, qdd): the joint torques are Y times the bodies' inertial parameters."""

from __future__ import annotations

import numpy as np

from spelgen.arm.arm import Arm


def regressor(arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Y (T, n, 10 B) at q, qd, qdd, each (T, n), of the arm's B bodies: tau = Y pi [Nm, N].

    Column 10 b + i belongs to parameter i of ``arm.bodies[b]``, in the order of ``Body.inertia``.
    """
    # what reads the URDF's own parameters alone starts without torch
    import torch

    from spelgen.dynamics.body_regressor import regressor_of
    from spelgen.dynamics.rigid_bodies import body_chain

    with torch.no_grad():
        states = [torch.tensor(x, dtype=torch.float64) for x in (q, qd, qdd)]
        rows: np.ndarray = regressor_of(body_chain(arm), *states).numpy()
    return rows


def urdf_parameters(arm: Arm) -> np.ndarray:
    """The URDF's own inertial parameters, (10 B,); zero for a body without."""
    return np.array([[float(x) for x in body.inertia or (0,) * 10] for body in arm.bodies]).ravel()
