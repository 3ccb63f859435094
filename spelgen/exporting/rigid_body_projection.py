"""Projection of a trained model onto rigid bodies with viscous and Coulomb friction."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.parameters import without_residuals
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.build import build
from spelgen.exporting.describe import array, servos_of
from spelgen.exporting.description import Servos
from spelgen.exporting.parity import nominal_speeds, random_inputs
from spelgen.exporting.tuning import TUNING
from spelgen.fitting.optimizers import minimise
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel


class NearestFriction(NamedTuple):
    """Viscous friction and Coulomb friction per direction, (n,) each; backward <= 0 <= forward.

    error: root mean square of the difference to the friction of a model over positions and speeds, relative to the root
    mean square of this friction.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    error: np.ndarray

    @property
    def coulomb(self) -> np.ndarray:
        """Mean Coulomb friction of both directions, (n,): a URDF and MuJoCo have one number."""
        return np.asarray((self.forward - self.backward) / 2)


@dataclass(frozen=True, eq=False)
class RigidBodyProjection:
    """An arm of n joints with the parameters that a URDF and its settings can have.

    inertias: (bodies, 10) inertial parameters in the frames of the joints, as in ``Body``. armature: (n,), of the
    motors [kg m^2, kg]. motors: C, (n, n), motor velocities per joint velocities. inputs: G at zero, (n, n). exact:
    whether the trained model has rigid bodies, which are used. mass_error, gravity_error: relative root mean square
    differences of M and gravity torque to the trained model. bodies: model of the rigid bodies only, float64.
    """

    arm: Arm
    inertias: np.ndarray
    armature: np.ndarray
    motors: np.ndarray
    friction: NearestFriction
    inputs: np.ndarray
    servos: Servos | None
    exact: bool
    mass_error: float
    gravity_error: float
    bodies: ArmModel

    @property
    def summary(self) -> tuple[str, str]:
        """Sentences on the differences of bodies and friction to the trained model."""
        bodies = "bodies are those of the model"
        if not self.exact or self.mass_error or self.gravity_error:
            source = "the rigid bodies nearest to the model"
            if self.exact:
                source = "those of the model without its residual terms"
            errors = f"M differs by {self.mass_error:.1%}, gravity by {self.gravity_error:.1%}"
            bodies = f"bodies are {source}; {errors}"
        worst = int(np.argmax(self.friction.error))
        joint = self.arm.chain.coordinates[worst]
        friction = "friction is written as viscous and Coulomb friction"
        error = f"it differs from the model's by up to {self.friction.error[worst]:.0%} ({joint.name})"
        return bodies, f"{friction}; {error}"


def rigid_body_projection(model: ArmModel, arm: Arm) -> RigidBodyProjection:
    """Return the projection of a trained model of ``arm``."""
    # a copy in double precision: the model of the user is not changed
    model = copy.deepcopy(model).double().cpu().requires_grad_(False)
    q = sampled_positions(arm.chain)
    # rigid bodies of the model need no search; residual terms are omitted, and the summary states it
    exact = isinstance(model, RigidBodyDynamics)
    bodies: ArmModel = without_residuals(model) if exact else _nearest_bodies(model, arm, q)
    return RigidBodyProjection(
        arm=arm,
        inertias=bodies.inertial_parameters.numpy(),
        armature=bodies.armature.numpy(),
        motors=motors_of(bodies).numpy(),
        friction=nearest_friction(arm.chain, model, q),
        inputs=array(model.input_matrix(torch.zeros(model.n, dtype=torch.float64))),
        servos=servos_of(model),
        exact=exact,
        mass_error=_relative_rms(bodies.mass_matrix(q), model.mass_matrix(q)),
        gravity_error=_relative_rms(bodies.gravity(q), model.gravity(q)),
        bodies=bodies,
    )


def sampled_positions(arm: Chain) -> Tensor:
    """Return random positions in the joints' ranges, (positions, n), the same in each call."""
    return torch.from_numpy(random_inputs(arm.coordinates, TUNING.positions)["q"])


def _nearest_bodies(model: ArmModel, arm: Arm, q: Tensor) -> ArmModel:
    """Return the physically consistent bodies with the smallest errors of M and gravity torque at q (positions, n).

    The cost is the mean of |W (M - M0) W^T|^2 / n + |g - g0|^2 / mean g0^2, with M0 and g0 of the model. W is the
    inverse Cholesky factor of the mean of M0, so that joints of small inertia at the tip have the same weight as
    joints at the base. A small ridge towards the URDF's bodies determines the parameters that M and g do not depend on.
    """
    bodies = build(arm, "closed-form")
    whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    mass = whitening @ model.mass_matrix(q) @ whitening.mT
    gravity = model.gravity(q)
    load = gravity.square().mean().sqrt().clamp(min=1e-9)

    def distance() -> Tensor:
        """Return the cost with its ridge, ()."""
        mass_error = whitening @ bodies.mass_matrix(q) @ whitening.mT - mass
        gravity_error = (bodies.gravity(q) - gravity) / load
        # parameters of zero are the URDF's bodies
        weights = torch.cat([parameter.flatten() for parameter in bodies.parameters()])
        distance: Tensor = (mass_error.square().sum() / model.n + gravity_error.square().sum()) / len(q)
        return distance + 0.5 * TUNING.ridge * weights.square().sum()

    minimise(bodies, lambda: [distance()], TUNING.steps)
    return bodies.requires_grad_(False)


def _relative_rms(values: Tensor, expected: Tensor) -> float:
    """Return the root mean square of values - expected, (...,) each, relative to the expected root mean square."""
    size = expected.square().mean().sqrt().clamp(min=1e-12)
    return float((values - expected).square().mean().sqrt() / size)


def nearest_friction(arm: Chain, model: ArmModel, q: Tensor) -> NearestFriction:
    """Return the viscous and Coulomb friction nearest to the friction of a model, by non-negative least squares.

    Args:
        arm: with the velocity limits.
        model: trained model.
        q: (positions, n) [rad, m], of which every k-th is used.
    """
    # friction changes most at low speed: logarithmic steps
    fractions = np.geomspace(0.02, 1.0, TUNING.friction_speeds)
    fractions = np.concatenate([-fractions[::-1], fractions])
    speeds = np.outer(fractions, nominal_speeds(arm.coordinates))
    positions = q[:: TUNING.positions // TUNING.friction_positions]
    positions = positions.unsqueeze(1).expand(-1, len(speeds), -1)  # (positions, speeds, n)
    qd = torch.from_numpy(speeds).expand_as(positions)
    torques = model.friction_torque(positions, qd).numpy()  # (positions, speeds, n)
    rows: list[tuple[float, float, float, float]] = []
    for joint, speed in enumerate(speeds.T):
        # opposite to the motion: viscous and Coulomb friction are then not negative
        torque = torques[..., joint] * np.sign(speed)
        columns = np.stack([np.abs(speed), speed > 0, speed < 0], axis=-1)
        (viscous, forward, backward), _ = nnls(columns, torque.mean(axis=0))
        residual = torque - columns @ (viscous, forward, backward)
        # a joint without friction has no residual
        error = np.linalg.norm(residual) / (np.linalg.norm(torque) or 1.0)
        rows.append((viscous, forward, -backward, float(error)))
    return NearestFriction(*np.array(rows).T)
