"""Noise levels of a fit: read from its run folder, or else estimated by cross-validation on its logs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.baselines.registry import arm_of_model
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.parameters import without_idle_residuals, without_residuals
from spelgen.dynamics.protocol import residual_terms
from spelgen.dynamics.tip_frame import tip_frame
from spelgen.emission.assemble import assemble
from spelgen.errors import LogError, RunError
from spelgen.files import read_json, write_json
from spelgen.fitting.fitted import Fit, required_spec
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import require
from spelgen.fitting.torque.fit import fit_torque
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.live.levels import find_levels
from spelgen.live.noise import NoiseLevels
from spelgen.logs.dynamics_samples import dynamics_samples
from spelgen.logs.trajectory import Trajectory
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import TorqueFit

FOLDS = 3
MIN_SAMPLES = 300
MAX_SAMPLES = 2**11


def noise_levels(fit: Fit) -> NoiseLevels:
    """Return the noise levels of a fit. Raises RunError if they are unknown, and cannot be found."""
    levels = stored_levels(fit)
    if levels is not None:
        return levels
    if not fit.logs:
        raise RunError(
            "no noise levels of the estimator", file=fit.folder, expected="a run with estimator.json",
            do=f"fit it again by `spelgen train` to torques, with at least {MIN_SAMPLES} samples of motion",
        )  # fmt: skip
    levels = cross_validated_levels(fit)
    keep_levels(fit, levels)
    return levels


def keep_levels(fit: Fit, levels: NoiseLevels | None = None) -> None:
    """Write noise levels into the run folder of a fit; None: estimate them first, if the fit is to torques."""
    if levels is None:
        if (
            not isinstance(fit.config, TorqueFit)
            or not isinstance(fit.model, RigidBodyDynamics)
            or not fit.logs
        ):
            return
        levels = cross_validated_levels(fit)
    if fit.folder is not None:
        write_json(RunFolder(fit.folder).estimator, levels.model_dump(mode="json"))


def stored_levels(fit: Fit) -> NoiseLevels | None:
    """Return the noise levels in the run folder of a fit; None if there are none."""
    run = None if fit.folder is None else RunFolder(fit.folder)
    if run is None or not run.estimator.exists():
        return None
    return require(NoiseLevels, read_json(run.estimator, RunError), run.estimator)


def cross_validated_levels(fit: Fit) -> NoiseLevels:
    """Return the noise levels by cross-validation: each fold of the logs is held out of a fit."""
    folds = [list(fit.logs[k::FOLDS]) for k in range(min(FOLDS, len(fit.logs)))]
    if len(folds) == 1:
        # thirds of one log
        (log,), ends = folds[0], np.linspace(0, len(folds[0][0]), FOLDS + 1).astype(int)
        folds = [[log[start:stop]] for start, stop in itertools.pairwise(ends)]
    arm = None if fit.urdf is None or not fit.urdf.exists() else arm_of_model(fit.model, fit.urdf)
    tested = []
    for k, fold in enumerate(folds):
        others = [log for j, other in enumerate(folds) if j != k for log in other]
        tested.append((fitted_to(fit, others), fold))
    levels = find_levels(tested, *limits(arm, fit.model.n))
    # rounded to the digits that a run folder contains
    return NoiseLevels.model_validate(levels.model_dump(mode="json"))


def fitted_to(fit: Fit, logs: Sequence[Trajectory]) -> RigidBodyDynamics:
    """Return the model of a fit, fitted to other logs from its initial parameters. Raises LogError for too little
    motion.

    A part of the samples suffices to estimate the error on other logs. Without residual terms in the fit, none are
    selected.
    """
    model = assemble(required_spec(fit.model)).double()
    if residual_terms(without_idle_residuals(fit.model)) is None:
        model = without_residuals(model)
    samples = dynamics_samples(logs, preprocessing=fit.preprocessing, reach=bristle_reach(model))
    samples = [x for x in samples if len(x.q)]
    if sum(len(x.q) for x in samples) < MIN_SAMPLES:
        raise LogError(
            "too little motion to find noise levels of the estimator",
            expected=f"{MIN_SAMPLES} samples that move in two thirds of the logs", do="record longer",
        )  # fmt: skip
    fit_torque(model, TorqueSamples.of(samples, TUNING.decimation).subsampled(MAX_SAMPLES))
    fitted = model.requires_grad_(False).eval()
    assert isinstance(fitted, RigidBodyDynamics)
    return fitted


def limits(arm: Arm | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the torque limits of an arm, (n,), infinite if unknown, and its tip in the last body's frame, (3,)."""
    if arm is None:
        return np.full(n, np.inf), np.zeros(3)
    effort = np.array([joint.effort or np.inf for joint in arm.chain.coordinates])
    tip = tip_frame(arm)
    is_last = tip.carrier == len(arm.chain.bodies) - 1
    return effort, tip.pose[:3, 3] if is_last else np.zeros(3)
