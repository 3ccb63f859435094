"""A trained model -> rigid bodies with friction: the model's own, or those that come nearest to it."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.optimize import nnls

from spelgen.arm.arm import Arm
from spelgen.building import build
from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.dynamics.residuals import without_residuals
from spelgen.fitting.optimizers import minimise
from spelgen.loaded_arm import LoadedArm
from spelgen.structure.nominal import working_range

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

POINTS = 512  # positions at which model and bodies are compared
STEPS = 400
RIDGE = 1e-8  # weight of half the squared logarithms by which bodies differ from the URDF's
SPEEDS = np.concatenate([-np.geomspace(1.0, 0.02, 25), np.geomspace(0.02, 1.0, 25)])  # of the usual speed
USUAL_SPEED = {"revolute": 1.0, "prismatic": 0.3}  # rad/s, m/s where the URDF names none


@dataclass(frozen=True, eq=False)
class RigidBodyProjection:
    """An arm of n joints as a URDF and its settings can say it.

    inertias: by body, ten parameters about the joint's frame as in ``Body``, (bodies, 10). armature: what the
    drives add to M by their own speeds, (n,) [kg m^2, kg]; motors: these speeds by the joints', (n, n).
    viscous, forward, backward: friction, (n,); backward is not positive.
    own: whether the bodies are the model's own. mass_error, gravity_error: root mean square of what M and gravity
    torque of bodies and model differ by, relative to the model's. friction_error: (n,) likewise, of friction.
    bodies: a model of these bodies alone, float64.
    """

    arm: LoadedArm
    inertias: np.ndarray
    armature: np.ndarray
    motors: np.ndarray
    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    friction_error: np.ndarray
    own: bool
    mass_error: float
    gravity_error: float
    bodies: Any

    @property
    def base_parameters(self) -> Mapping[str, float]:
        """The bodies' base parameters by the names that ``inspect`` and ``identify`` give them."""
        ten = self.inertias.ravel()
        return {
            each.name: sum(float(weight) * float(ten[k]) for k, weight in each.weights)
            for each in self.arm.base_parameters
        }


def rigid_body_projection(model: EmittedModel, arm: LoadedArm) -> RigidBodyProjection:
    """The bodies, armature and friction of a trained model of ``arm``."""
    model = copy.deepcopy(model).double().requires_grad_(False)
    q = sampled_positions(arm.arm)
    own = has_rigid_bodies(model)
    bodies: Any = _own(model) if own else _nearest(model, arm, q)
    mass, gravity = _errors(model, bodies, q)
    viscous, forward, backward, missed = _friction(arm.arm, model, q)
    return RigidBodyProjection(
        arm=arm,
        inertias=bodies.inertial_parameters.numpy(),
        armature=bodies.armature.numpy(),
        motors=bodies.motors.numpy(),
        viscous=viscous,
        forward=forward,
        backward=backward,
        friction_error=missed,
        own=own,
        mass_error=mass,
        gravity_error=gravity,
        bodies=bodies,
    )


def sampled_positions(arm: Arm) -> torch.Tensor:
    """Positions over the joints' ranges, (POINTS, n), the same each time."""
    random = np.random.default_rng(0)
    columns = [random.uniform(*working_range(coordinate), POINTS) for coordinate in arm.coordinates]
    return torch.from_numpy(np.stack(columns, axis=-1))


def _own(model: EmittedModel) -> EmittedModel:
    """The model without what it has beside rigid bodies."""
    alone: EmittedModel = without_residuals(model)
    return alone


def _nearest(model: EmittedModel, arm: LoadedArm, q: torch.Tensor) -> EmittedModel:
    """The possible rigid bodies whose M and gravity torque are nearest to the model's.

    Where these say nothing of a body's parameters it keeps the URDF's.
    """
    bodies = build(arm, "closed-form")
    whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    mass = whitening @ model.mass_matrix(q) @ whitening.mT
    gravity = model.gravity(q)
    unit = gravity.square().mean().sqrt().clamp(min=1e-9)

    def distance() -> torch.Tensor:
        missed = whitening @ bodies.mass_matrix(q) @ whitening.mT - mass
        load = (bodies.gravity(q) - gravity) / unit
        moved = torch.cat([parameter.flatten() for parameter in bodies.parameters()])
        return (
            missed.square().sum(dim=(-2, -1)).mean() / mass.shape[-1]
            + load.square().sum(dim=-1).mean()
            + 0.5 * RIDGE * moved.square().sum()
        )

    minimise(bodies, distance, STEPS)
    return bodies.requires_grad_(False)


def _errors(model: EmittedModel, bodies: EmittedModel, q: torch.Tensor) -> tuple[float, float]:
    pairs = ((model.mass_matrix(q), bodies.mass_matrix(q)), (model.gravity(q), bodies.gravity(q)))
    mass, gravity = (
        float((found - true).square().mean().sqrt() / true.square().mean().sqrt().clamp(min=1e-12))
        for true, found in pairs
    )
    return mass, gravity


def _friction(arm: Arm, model: EmittedModel, q: torch.Tensor) -> tuple[np.ndarray, ...]:
    """Viscous and Coulomb friction nearest to the model's at these positions, and what is missed of it."""
    usual = np.array([c.velocity or USUAL_SPEED[c.kind] for c in arm.coordinates])
    qd = torch.from_numpy(np.outer(SPEEDS, usual))
    places = q[:: POINTS // 32].unsqueeze(1).expand(-1, len(qd), -1)
    lost = model.friction_torque(places, qd.expand_as(places)).numpy()
    found = []
    for speed, torque in zip(qd.numpy().T, lost.T, strict=True):  # torque: (speeds, positions)
        columns = np.stack([speed, speed > 0, -1.0 * (speed < 0)], axis=-1) * np.sign(speed)[:, None]
        (viscous, forward, backward), _ = nnls(columns, torque.mean(axis=1) * np.sign(speed))
        fitted = columns @ (viscous, forward, backward) * np.sign(speed)
        missed, size = np.linalg.norm(torque - fitted[:, None]), np.linalg.norm(torque)
        found.append((viscous, forward, -backward, missed / size if size else 0.0))
    return tuple(np.array(column) for column in zip(*found, strict=True))
