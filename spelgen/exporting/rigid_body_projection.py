"""A trained run -> rigid bodies with friction: the model's own, or those that come nearest to it."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.optimize import nnls

from spelgen import pipeline
from spelgen.arm.arm import Arm
from spelgen.fitting.optimizers import minimise
from spelgen.fitting.run_folder import RunFolder, load_model, trained_model
from spelgen.spec import Header, read_header
from spelgen.structure.nominal import working_range

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

POINTS = 512  # positions at which model and twin are compared
STEPS = 400
STRAY = 1e-8  # weight of half the squared logarithms by which bodies differ from the URDF's
SPEEDS = np.concatenate([-np.geomspace(1.0, 0.02, 25), np.geomspace(0.02, 1.0, 25)])  # of the usual speed
USUAL_SPEED = {"revolute": 1.0, "prismatic": 0.3}  # rad/s, m/s where the URDF names none


@dataclass(frozen=True, eq=False)
class Twin:
    """An arm of n joints as a URDF and its settings can say it.

    inertias: by body, ten parameters about the joint's frame as in ``Body``, (bodies, 10). rotors: what the
    drives add to M, (n,) [kg m^2, kg]. viscous, forward, backward: friction, (n,); backward is not positive.
    mass_error, gravity_error: root mean square of what M and gravity torque of twin and model differ by,
    relative to the model's; None where the model is its own twin. friction_error: (n,) likewise, of friction.
    """

    arm: Arm
    inertias: np.ndarray
    rotors: np.ndarray
    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    friction_error: np.ndarray
    mass_error: float | None
    gravity_error: float | None


def make_twin(run: RunFolder) -> Twin:
    """The twin of a run's best model. Raises RunError for what the run lacks, and what `pipeline.load` raises."""
    model = trained_model(run)
    header = read_header(run.module)
    arm = pipeline.load(run.urdf, header.joints, snap_tolerance=header.options.snap_tolerance).arm
    q = _positions(arm)
    own = header.options.preset == "closed-form"
    bodies: Any = model if own else _fitted(run, header, model, q)
    mass, gravity = (None, None) if own else _errors(model, bodies, q)
    prepared = bodies.prepare()
    viscous, forward, backward, left = _friction(arm, model, q)
    return Twin(
        arm=arm,
        inertias=bodies.inertial_parameters().detach().numpy(),
        rotors=prepared.rotors.detach().numpy(),
        viscous=viscous,
        forward=forward,
        backward=backward,
        friction_error=left,
        mass_error=mass,
        gravity_error=gravity,
    )


def _positions(arm: Arm) -> torch.Tensor:
    random = np.random.default_rng(0)
    columns = [random.uniform(*working_range(coordinate), POINTS) for coordinate in arm.coordinates]
    return torch.from_numpy(np.stack(columns, axis=-1))


def _fitted(run: RunFolder, header: Header, model: EmittedModel, q: torch.Tensor) -> EmittedModel:
    """The possible rigid bodies whose M and gravity torque are nearest to the model's.

    Where these say nothing of a body's parameters it keeps the URDF's.
    """
    options = header.options
    source = pipeline.build(
        run.urdf, header.joints, snap_tolerance=options.snap_tolerance, preset="closed-form"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "twin.py"
        path.write_text(source, encoding="utf-8")
        twin = load_model(path)
    whitening = torch.linalg.inv(torch.linalg.cholesky(model.mass_matrix(q).mean(dim=0)))
    mass = whitening @ model.mass_matrix(q) @ whitening.mT
    gravity = model.gravity(q)
    unit = gravity.square().mean().sqrt().clamp(min=1e-9)

    def distance() -> torch.Tensor:
        missed = whitening @ twin.mass_matrix(q) @ whitening.mT - mass
        load = (twin.gravity(q) - gravity) / unit
        stray = torch.cat([parameter.flatten() for parameter in twin.parameters()])
        return (
            missed.square().sum(dim=(-2, -1)).mean() / mass.shape[-1]
            + load.square().sum(dim=-1).mean()
            + 0.5 * STRAY * stray.square().sum()
        )

    minimise(twin, distance, STEPS)
    return twin.requires_grad_(False)


def _errors(model: EmittedModel, twin: EmittedModel, q: torch.Tensor) -> tuple[float, float]:
    pairs = ((model.mass_matrix(q), twin.mass_matrix(q)), (model.gravity(q), twin.gravity(q)))
    mass, gravity = (
        float((found - true).square().mean().sqrt() / true.square().mean().sqrt().clamp(min=1e-12))
        for true, found in pairs
    )
    return mass, gravity


def _friction(arm: Arm, model: EmittedModel, q: torch.Tensor) -> tuple[np.ndarray, ...]:
    """Viscous and Coulomb friction nearest to the model's, mean over positions, and what is missed of it."""
    usual = np.array([c.velocity or USUAL_SPEED[c.kind] for c in arm.coordinates])
    qd = torch.from_numpy(np.outer(SPEEDS, usual))
    places = q[:: POINTS // 32]
    with torch.no_grad():
        grid = places.unsqueeze(1).expand(-1, len(qd), -1)
        speeds = qd.expand_as(grid)
        lost = (model.dissipation(grid, speeds) @ speeds.unsqueeze(-1)).squeeze(-1).mean(dim=0).numpy()
    found = []
    for speed, torque in zip(qd.numpy().T, lost.T, strict=True):
        columns = np.stack([speed, speed > 0, -1.0 * (speed < 0)], axis=-1)
        (viscous, forward, backward), missed = nnls(
            columns * np.sign(speed)[:, None], torque * np.sign(speed)
        )
        size = np.linalg.norm(torque)
        found.append((viscous, forward, -backward, missed / size if size else 0.0))
    return tuple(np.array(column) for column in zip(*found, strict=True))
