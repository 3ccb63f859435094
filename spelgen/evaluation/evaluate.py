"""Judge a model on test logs, beside its baselines, on the same windows and with the same integrator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spelgen.baselines.baseline import CommandFollower, JudgedArm
from spelgen.baselines.names import MODEL
from spelgen.baselines.predictor import Predictor, accurate_solver, of_dynamics
from spelgen.baselines.registry import BASELINES
from spelgen.dynamics.protocol import input_of
from spelgen.dynamics.residuals import used_parameter_count, without_idle_residuals
from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import Diagnostic, LogError, in_one_line
from spelgen.evaluation.horizons import (
    Horizon,
    JudgedLogs,
    Predictions,
    TipPosition,
    horizon_lengths,
    predict,
)
from spelgen.evaluation.replay import replays
from spelgen.evaluation.results import Results
from spelgen.evaluation.subject import Subject, subject
from spelgen.evaluation.torque import TorqueErrors, coarse_torques, torque_errors
from spelgen.evaluation.traces import Traces, motion_traces, replay_traces
from spelgen.evaluation.tuning import TUNING
from spelgen.logs.checks import check
from spelgen.logs.dynamics_samples import SHORTEST, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.rates import SLOWEST
from spelgen.logs.trajectory import Trajectory, require_commands, require_joints, require_torques

if TYPE_CHECKING:
    from spelgen.dynamics.protocol import RigidDynamics
    from spelgen.emission.loading import EmittedModel
    from spelgen.fitting.fitted import Fit
    from spelgen.pipeline.loaded_arm import LoadedArm

STEPS: Sequence[int] = (1, 10)
SECONDS: Sequence[float] = (1.0,)
Progress = Callable[[int, int, str], None]


def evaluate(
    model: EmittedModel | Fit | Path | str,
    logs: Trajectory | Sequence[Trajectory],
    *,
    arm: LoadedArm | Path | str | None = None,
    baselines: Mapping[str, RigidDynamics] | None = None,
    preprocessing: Preprocessing | None = None,
    steps: Sequence[int] = STEPS,
    seconds: Sequence[float] = SECONDS,
    progress: Progress | None = None,
) -> Results:
    """Predict the states and torques of test logs and measure the errors.

    model: an emitted one, a fit, or the folder of a run. arm: of ``load_arm``, or the path of a URDF; by default
    the fit's: it gives the URDF as a baseline, and errors of the tip. baselines: other dynamics to be judged beside
    those of `baselines.registry` and what the fit's folder keeps, by name, e.g. ``{"truth": identify(...).dynamics}``.
    preprocessing: of states and torques; by default as the model was fitted. steps, seconds: horizons in samples and in
    time; those longer than every trajectory are omitted, with a note. progress: called with the rollouts that are done,
    all of them, and the name of the next one.
    All that has dynamics is judged open loop, and with the constant disturbance that a momentum observer finds before a
    prediction starts (see `momentum_observer.py`). The result is deterministic. Raises LogError.
    """
    judged = subject(model, arm)
    logs = [logs] if isinstance(logs, Trajectory) else list(logs)
    for trajectory in logs:
        require_joints(trajectory, judged.joints)
    notes = check(logs, judged.joints, judged.model.joint_types)
    seen = [trajectory.name for trajectory in logs if trajectory.name in judged.trained_on]
    if seen:  # names are all that a run keeps of its logs
        message = (
            f"names also used in training: {', '.join(seen)}; errors on training data are not test errors"
        )
        notes.append(Diagnostic("warning", "tested-on-training-data", "logs", None, message))
    if input_of(judged.model) == "position":
        if baselines:
            raise LogError(
                "baselines that take torques", expected="none: the model is one of position servos"
            )
        return _judge_commands(judged, logs, notes)
    require_torques(logs)
    used = _preprocessing(judged.fit.preprocessing if judged.fit else None, preprocessing, logs)
    return _judge_torques(judged, logs, notes, used, baselines or {}, (steps, seconds), progress)


def _preprocessing(
    used: Preprocessing | None, chosen: Preprocessing | None, logs: Sequence[Trajectory]
) -> Preprocessing:
    """Return how logs are prepared: as is chosen, else as for the fit, if there was one."""
    if chosen is None and used is not None:
        return used
    preprocessing = chosen or Preprocessing()
    if used is not None and preprocessing.torque_delay is None:  # of the logger, whatever the filter
        preprocessing = replace(preprocessing, torque_delay=used.torque_delay)
    return preprocessing.resolved([trajectory.sample_rate for trajectory in logs])


def _judge_torques(
    judged: Subject,
    logs: Sequence[Trajectory],
    notes: list[Diagnostic],
    used: Preprocessing,
    baselines: Mapping[str, RigidDynamics],
    ahead: tuple[Sequence[int], Sequence[float]],
    progress: Progress | None,
) -> Results:
    """Judge torques, and the motion that they predict."""
    all_samples = dynamics_samples(logs, pauses=True, preprocessing=used, reach=judged.reach)
    samples = [sample for sample in all_samples if len(sample.q)]
    # a rollout takes a start and a sample after it
    tests = JudgedLogs(used.pieces(logs, shortest=2), samples, used, judged.reach, judged.model.joint_types)
    lengths = horizon_lengths(tests, *ahead, notes)
    probe = tests.windows(judged.window - 1, TUNING.probed_model_windows)
    # residual terms that were not selected add nothing but time
    model = without_idle_residuals(judged.model)
    solver = accurate_solver(model, probe)
    predictors = [Predictor(MODEL, solver, model)]
    for baseline in BASELINES:
        predictors += baseline.predictors(JudgedArm(judged.joints, judged.urdf, judged.run, probe, notes))
    for name, dynamics in baselines.items():
        predictors.append(of_dynamics(name, dynamics, probe))
    tip = _tip(judged, notes)
    horizons: list[Horizon] = []
    longest: Predictions | None = None
    for name, k in lengths.items():
        if progress is not None:
            progress(len(horizons), len(lengths), f"predicting {name} ahead")
        horizon, predictions = predict(name, k, tests, predictors, tip, notes)
        horizons.append(horizon)
        # the curves of the longest horizon show the shorter ones on their way
        if k == max(lengths.values()):
            longest = predictions
    judged_dynamics: dict[str, RigidDynamics] = {}
    torque: dict[str, TorqueErrors] = {}
    for predictor in predictors:
        if predictor.dynamics is not None:
            judged_dynamics[predictor.name] = predictor.dynamics
            if samples:
                torque[predictor.name] = torque_errors(predictor.dynamics, samples)
    if not horizons and not torque:
        raise LogError(
            "no figure: no rollout is evaluated, and torques need accelerations, which these logs do not show",
            expected=f"motion at {SLOWEST:g} Hz or more, {SHORTEST:g} s without a gap",
            do="omit --quick",
        )
    steps = coarse_torques(logs, judged.joints, notes) if torque else {}
    return _results(
        judged,
        logs,
        notes,
        motion_traces(judged_dynamics, tests, longest, tip),
        cutoff=used.cutoff or None,
        substeps=solver.substeps,
        horizons=tuple(horizons),
        torque=torque,
        torque_steps=steps,
    )


def _results(
    judged: Subject, logs: Sequence[Trajectory], notes: Sequence[Diagnostic], traces: Traces, **figures: Any
) -> Results:
    """Return results that name the arm and the logs."""
    return Results(
        robot=judged.facts.robot if judged.facts else type(judged.model).__name__,
        joints=tuple(judged.joints),
        joint_types=tuple(judged.model.joint_types),
        trajectories=tuple(trajectory.name for trajectory in logs),
        parameters=used_parameter_count(judged.model),
        diagnostics=tuple(notes),
        traces=traces,
        **figures,
    )


def _judge_commands(judged: Subject, logs: Sequence[Trajectory], notes: list[Diagnostic]) -> Results:
    """Judge the positions that follow commands, which are replayed."""
    followers: dict[str, CommandFollower] = {}
    for trajectory in logs:
        require_commands(trajectory)
    for baseline in BASELINES:
        followers |= baseline.followers(judged.fit, notes)
    errors, missed = replays(judged.model, logs, followers, notes)
    return _results(judged, logs, notes, replay_traces(missed), replays=errors)


def _tip(judged: Subject, notes: list[Diagnostic]) -> TipPosition | None:
    if judged.urdf is None:
        return None
    try:
        tip = judged.facts.options.tip if judged.facts else None
        return tip_kinematics(judged.urdf, tip, joints=judged.joints).position
    except Exception as error:  # pytorch-kinematics raises many kinds; the evaluation stands without
        message = f"no tip errors: {in_one_line(error)}"
        notes.append(Diagnostic("info", "no-tip", judged.urdf.name, None, message))
        return None
