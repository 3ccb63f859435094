"""Kinematics and regressor of the bodies of an arm: joint torques are Y times their inertial parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.body_regressor import chain_regressor
from spelgen.runtime.body_chain import BodyChain
from spelgen.runtime.parts import Row


def body_chain(arm: Arm) -> BodyChain:
    """Return the kinematics of the bodies of an arm."""
    rows: list[tuple[Any, ...]] = []
    for body in arm.bodies:
        placement = [(*_row(row), float(x)) for row, x in zip(body.rotation, body.translation, strict=True)]
        is_revolute, ratio = body.kind == "revolute", float(body.multiplier)
        rows.append((body.parent, body.coordinate, is_revolute, ratio, body.offset, placement))
    return BodyChain(len(arm.coordinates), _row(arm.gravity), *zip(*rows, strict=True))


def regressor(arm: Arm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return Y (T, n, 10 B) of the arm's B bodies at q, qd, qdd, each (T, n): tau = Y pi [Nm, N].

    Column 10 b + i belongs to parameter i of ``arm.bodies[b]``, in the order of ``Body.inertia``.
    """
    return chain_regressor(body_chain(arm), q, qd, qdd)


def urdf_parameters(arm: Arm) -> np.ndarray:
    """Return the inertial parameters of the URDF, (10 B,); zero for a body without inertial."""
    return np.array([body.inertia or (0,) * 10 for body in arm.bodies], dtype=float).ravel()


def _row(values: tuple[object, object, object]) -> Row:
    return tuple(map(float, values))  # type: ignore[arg-type]
