"""Approximation of a trained model by rigid bodies with viscous and Coulomb friction."""

import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.parameters import without_residuals
from spelgen.emission.assemble import ArmModel
from spelgen.emission.build import build
from spelgen.exporting.describe import Servos, array, servos_of
from spelgen.exporting.parity import nominal_speeds, random_inputs
from spelgen.exporting.tuning import TUNING
from spelgen.fitting.optimizers import minimise
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


class NearestFriction(NamedTuple):
    """Viscous and Coulomb friction that approximate the friction of a model best, (n,) each.

    A URDF or MuJoCo can represent this friction, but not the friction of a model.

    Attributes:
        viscous: coefficients [Nm s/rad, N s/m].
        forward, backward: Coulomb torques [Nm, N] in both directions of motion, backward <= 0 <= forward.
        error: RMS difference between this friction and the model's friction over positions and speeds, divided by the
            RMS of the model's friction.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    error: np.ndarray

    @property
    def coulomb(self) -> np.ndarray:
        """Mean Coulomb friction of both directions, (n,) [Nm, N], since a URDF and MuJoCo have one value per joint."""
        return np.asarray((self.forward - self.backward) / 2)


@dataclass(frozen=True, eq=False)
class RigidBodyProjection:
    """A trained model approximated by rigid bodies, in the form that a URDF and a settings file can contain.

    Attributes:
        arm: arm of the model, with n joints.
        friction: viscous and Coulomb friction that approximate the model's friction.
        inputs: G at q = 0, (n, n), joint torques = G times motor torques.
        servos: position servos of the model; None for an arm under torques.
        exact: True if the bodies are the rigid bodies of the trained model; False if they were fitted to a model of
            another kind.
        mass_error: RMS of (M of the rigid bodies - M of the trained model), divided by the RMS of M of the trained
            model.
        gravity_error: the same ratio for the gravity torque.
        bodies: float64 model that consists of the rigid bodies and rotor inertias only.
    """

    arm: Arm
    friction: NearestFriction
    inputs: np.ndarray
    servos: Servos | None
    exact: bool
    mass_error: float
    gravity_error: float
    bodies: ArmModel

    @property
    def summary(self) -> tuple[str, str]:
        """Two sentences for the user on differences from the trained model: of the rigid bodies, and of friction."""
        bodies = "bodies are those of the model"
        if not self.exact or self.mass_error or self.gravity_error:
            source = "the rigid bodies nearest to the model"
            if self.exact:
                source = "those of the model without its residual terms"
            errors = f"M differs by {self.mass_error:.1%}, gravity by {self.gravity_error:.1%}"
            bodies = f"bodies are {source}; {errors}"
        worst = int(np.argmax(self.friction.error))
        joint, largest = self.arm.chain.joint_names[worst], self.friction.error[worst]
        error = f"it differs from the model's by up to {largest:.0%} ({joint})"
        return bodies, f"friction is written as viscous and Coulomb friction; {error}"


def rigid_body_projection(model: ArmModel, arm: Arm) -> RigidBodyProjection:
    """Return the approximation of a trained model by rigid bodies with viscous and Coulomb friction.

    A rigid-body model keeps its bodies, without its residual terms. For other models, rigid bodies are fitted to M and
    the gravity torque at random positions. Friction is always fitted, by least squares.
    """
    # The model is copied and converted to double precision, so that the user's model is not changed.
    model = copy.deepcopy(model).double().cpu().requires_grad_(False)
    # The seed is fixed, so that the result is reproducible.
    q = torch.from_numpy(random_inputs(arm.chain.coordinates, TUNING.positions)["q"])
    # The model's own rigid bodies are used if it has some; its residual terms are omitted. The summary of the export
    # states this.
    exact = isinstance(model, RigidBodyDynamics)
    bodies = without_residuals(model) if exact else _nearest_bodies(model, arm, q)
    return RigidBodyProjection(
        arm=arm,
        friction=nearest_friction(arm.chain, model, q),
        inputs=array(model.input_matrix(torch.zeros(model.n, dtype=torch.float64))),
        servos=servos_of(model),
        exact=exact,
        mass_error=_relative_rms(bodies.mass_matrix(q), model.mass_matrix(q)),
        gravity_error=_relative_rms(bodies.gravity(q), model.gravity(q)),
        bodies=bodies,
    )


def _nearest_bodies(model: ArmModel, arm: Arm, q: Tensor) -> ArmModel:
    """Return the model of physically consistent rigid bodies that best fits M and gravity torque at q, (positions, n).

    The cost is the mean over q of |W (M - M0) W^T|^2 / n + |g - g0|^2 / mean g0^2, with M and g of the rigid bodies, M0
    and g0 of the given model. W is the inverse Cholesky factor of the mean of M0: with it, joints of small inertia at
    the tip have the same weight as joints at the base. A small ridge penalty towards the URDF determines the parameters
    on which M and g do not depend.
    """
    bodies = build(arm, "closed-form")
    whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    mass = whitening @ model.mass_matrix(q) @ whitening.mT
    gravity = model.gravity(q)
    load = gravity.square().mean().sqrt().clamp(min=1e-9)

    def distance() -> Tensor:
        """Return the cost of `_nearest_bodies`, a scalar, for the current parameters of the rigid bodies."""
        mass_error = whitening @ bodies.mass_matrix(q) @ whitening.mT - mass
        gravity_error = (bodies.gravity(q) - gravity) / load
        # The parameters represent differences from the values in the URDF. The ridge penalty towards the URDF is
        # therefore the sum of their squares.
        weights = torch.cat([parameter.flatten() for parameter in bodies.parameters()])
        distance: Tensor = (mass_error.square().sum() / model.n + gravity_error.square().sum()) / len(q)
        return distance + 0.5 * TUNING.ridge * weights.square().sum()

    minimise(bodies, lambda: [distance()], TUNING.steps)
    return bodies.requires_grad_(False)


def _relative_rms(values: Tensor, expected: Tensor) -> float:
    """Return RMS(values - expected) / RMS(expected) for two tensors (...,)."""
    size = expected.square().mean().sqrt().clamp(min=1e-12)
    return float((values - expected).square().mean().sqrt() / size)


def nearest_friction(arm: Chain, model: ArmModel, q: Tensor) -> NearestFriction:
    """Return the viscous and Coulomb friction with the least squared difference from the friction of a model.

    Coefficients [Nm s/rad, N s/m] and [Nm, N] are non-negative. The model's friction is averaged over positions. It is
    evaluated at speeds of 2 to 100 % of each joint's nominal speed in both directions, in logarithmic steps.

    Args:
        arm: arm with velocity limits.
        model: trained model.
        q: (positions, n) [rad, m]; evenly spaced rows are used.
    """
    # Speeds have logarithmic steps, because friction changes most at low speed.
    fractions = np.geomspace(0.02, 1.0, TUNING.friction_speeds)
    fractions = np.concatenate([-fractions[::-1], fractions])
    speeds = np.outer(fractions, nominal_speeds(arm.coordinates))
    positions = q[:: TUNING.positions // TUNING.friction_positions]
    positions = positions.unsqueeze(1).expand(-1, len(speeds), -1)  # q [rad, m], (positions, speeds, n)
    qd = torch.from_numpy(speeds).expand_as(positions)
    torques = model.friction_torque(positions, qd).numpy()  # torques: (positions, speeds, n)
    rows = []
    for joint, speed in enumerate(speeds.T):
        # The torques are multiplied by the sign of the velocity: friction that opposes the motion is then positive in
        # both directions. `nnls` returns only non-negative coefficients.
        torque = torques[..., joint] * np.sign(speed)
        columns = np.stack([np.abs(speed), speed > 0, speed < 0], axis=-1)
        (viscous, forward, backward), _ = nnls(columns, torque.mean(axis=0))
        residual = torque - columns @ (viscous, forward, backward)
        # The error of a joint without friction is zero, not 0 / 0.
        error = np.linalg.norm(residual) / (np.linalg.norm(torque) or 1.0)
        rows.append((viscous, forward, -backward, float(error)))
    return NearestFriction(*np.array(rows).T)
