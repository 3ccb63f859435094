"""A trained model -> rigid bodies with friction: the model's own, or the nearest ones."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from spelgen.arm.arm import Arm
from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.residuals import without_residuals
from spelgen.emission.build import build
from spelgen.exporting.describe import array, servos_of
from spelgen.exporting.description import Servos
from spelgen.exporting.parity import random_inputs, usual_speeds
from spelgen.exporting.tuning import TUNING
from spelgen.fitting.optimizers import minimise
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel


class NearestFriction(NamedTuple):
    """Viscous and Coulomb friction forward and backward, (n,) each; backward is not positive.

    error: root mean square of the difference to a model's friction, relative to that, over positions and speeds.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    error: np.ndarray


@dataclass(frozen=True, eq=False)
class RigidBodyProjection:
    """An arm of n joints as a URDF and its settings can say it.

    inertias: by body, ten parameters about the joint's frame as in ``Body``, (bodies, 10). armature: of the
    drives by their own speeds, (n,) [kg m^2, kg]; motors: these speeds by the joints', (n, n).
    inputs: G at zero, (n, n). own: whether the bodies are the model's own. mass_error, gravity_error: root mean square
    of the difference of M and of gravity torque, relative to the model's. bodies: a model of them alone, float64.
    """

    arm: ConfiguredArm
    inertias: np.ndarray
    armature: np.ndarray
    motors: np.ndarray
    friction: NearestFriction
    inputs: np.ndarray
    servos: Servos | None
    own: bool
    mass_error: float
    gravity_error: float
    bodies: ArmModel

    @property
    def summary(self) -> tuple[str, str]:
        """How near bodies and friction are to the model's, a sentence each."""
        bodies = "bodies are those of the model"
        if not self.own or self.mass_error or self.gravity_error:
            which = "the rigid bodies nearest to the model"
            if self.own:
                which = "those of the model without its residual terms"
            errors = f"M differs by {self.mass_error:.1%}, gravity by {self.gravity_error:.1%}"
            bodies = f"bodies are {which}; {errors}"
        worst = int(np.argmax(self.friction.error))
        joint = self.arm.arm.coordinates[worst]
        friction = "friction is written as viscous and Coulomb friction"
        error = f"it differs from the model's by up to {self.friction.error[worst]:.0%} ({joint.name})"
        return bodies, f"{friction}; {error}"


def rigid_body_projection(model: ArmModel, arm: ConfiguredArm) -> RigidBodyProjection:
    """Return the bodies, armature and friction of a trained model of ``arm``."""
    model = copy.deepcopy(model).double().cpu().requires_grad_(False)
    q = sampled_positions(arm.arm)
    own = isinstance(model, RigidBodyDynamics)
    bodies: ArmModel = without_residuals(model) if own else _nearest_bodies(model, arm, q)
    return RigidBodyProjection(
        arm=arm,
        inertias=bodies.inertial_parameters.numpy(),
        armature=bodies.armature.numpy(),
        motors=motors_of(bodies).numpy(),
        friction=nearest_friction(arm.arm, model, q),
        inputs=array(model.input_matrix(torch.zeros(model.n, dtype=torch.float64))),
        servos=servos_of(model),
        own=own,
        mass_error=_relative_rms(bodies.mass_matrix(q), model.mass_matrix(q)),
        gravity_error=_relative_rms(bodies.gravity(q), model.gravity(q)),
        bodies=bodies,
    )


def sampled_positions(arm: Arm) -> Tensor:
    """Return positions over the joints' ranges, (positions, n), the same each time."""
    return torch.from_numpy(random_inputs(arm.coordinates, TUNING.positions)["q"])


def _nearest_bodies(model: ArmModel, arm: ConfiguredArm, q: Tensor) -> ArmModel:
    """Return the physically consistent bodies whose M and gravity torque are nearest to the model's.

    Where these leave a body's parameters open it keeps the URDF's.
    """
    bodies = build(arm, "closed-form")
    # light joints at the tip count as much as heavy ones at the base
    whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    mass = whitening @ model.mass_matrix(q) @ whitening.mT
    gravity = model.gravity(q)
    load = gravity.square().mean().sqrt().clamp(min=1e-9)

    def distance() -> Tensor:
        mass_error = whitening @ bodies.mass_matrix(q) @ whitening.mT - mass
        gravity_error = (bodies.gravity(q) - gravity) / load
        # zero weights are the URDF's bodies
        weights = torch.cat([parameter.flatten() for parameter in bodies.parameters()])
        distance: Tensor = (mass_error.square().sum() / model.n + gravity_error.square().sum()) / len(q)
        return distance + 0.5 * TUNING.ridge * weights.square().sum()

    minimise(bodies, lambda: [distance()], TUNING.steps)
    return bodies.requires_grad_(False)


def _relative_rms(values: Tensor, expected: Tensor) -> float:
    size = expected.square().mean().sqrt().clamp(min=1e-12)
    return float((values - expected).square().mean().sqrt() / size)


def nearest_friction(arm: Arm, model: ArmModel, q: Tensor) -> NearestFriction:
    """Return the viscous and Coulomb friction nearest to the model's."""
    fractions = np.geomspace(0.02, 1.0, TUNING.friction_speeds)
    fractions = np.concatenate([-fractions[::-1], fractions])
    speeds = np.outer(fractions, usual_speeds(arm.coordinates))
    positions = q[:: TUNING.positions // TUNING.friction_positions]
    positions = positions.unsqueeze(1).expand(-1, len(speeds), -1)  # (positions, speeds, n)
    qd = torch.from_numpy(speeds).expand_as(positions)
    torques = model.friction_torque(positions, qd).numpy()  # (positions, speeds, n)
    rows: list[tuple[float, float, float, float]] = []
    for joint, speed in enumerate(speeds.T):
        # against the motion, so that what friction may be is not negative
        torque = torques[..., joint] * np.sign(speed)
        columns = np.stack([np.abs(speed), speed > 0, speed < 0], axis=-1)
        (viscous, forward, backward), _ = nnls(columns, torque.mean(axis=0))
        missed = torque - columns @ (viscous, forward, backward)
        # without friction nothing is missed either
        error = np.linalg.norm(missed) / (np.linalg.norm(torque) or 1.0)
        rows.append((viscous, forward, -backward, float(error)))
    return NearestFriction(*np.array(rows).T)
