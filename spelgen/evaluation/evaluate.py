"""Judge a model on test logs, beside its baselines, on the same windows and with the same integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spelgen.baselines.baseline import JudgedArm
from spelgen.baselines.names import MODEL
from spelgen.baselines.predictor import of_accurate_dynamics, of_dynamics
from spelgen.baselines.registry import BASELINES
from spelgen.dynamics.protocol import has_servos
from spelgen.errors import Diagnostic, LogError
from spelgen.evaluation.horizons import PROBED, JudgedLogs, horizon_lengths, predict
from spelgen.evaluation.invariants import energy_drift
from spelgen.evaluation.replay import replays
from spelgen.evaluation.results import Results, torque_summary
from spelgen.evaluation.subject import Subject, subject
from spelgen.evaluation.torque import torque_errors
from spelgen.evaluation.traces import replay_traces, traces
from spelgen.fitting.rollout import choose_substeps, loss_scales
from spelgen.identification.samples import dynamics_samples
from spelgen.logs.checks import check
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques

if TYPE_CHECKING:
    from spelgen.dynamics.protocol import RigidDynamics
    from spelgen.dynamics.tip import TipKinematics


def evaluate(
    model: Any,
    logs: Trajectory | Sequence[Trajectory],
    *,
    arm: Any = None,
    baselines: Mapping[str, RigidDynamics] | None = None,
    preprocessing: Preprocessing | None = None,
    steps: Sequence[int] = (1, 10),
    seconds: Sequence[float] = (1.0,),
) -> Results:
    """Predict the states and torques of test logs and measure the errors.

    model: an emitted one, a fit, or the folder of a run. arm: of ``load_arm``, or the path of a URDF; by default
    the fit's: it gives the URDF as a baseline, and errors of the tip. baselines: other dynamics to be judged beside
    those of `baselines.registry` and what the fit's folder keeps, by name, e.g. ``{"truth": identify(...).dynamics}``.
    preprocessing: of states and torques; by default as the model was fitted. steps, seconds: horizons in samples and in
    time; those longer than every trajectory are left out, and said.
    All that has dynamics is judged open loop, and with the disturbance held that a momentum observer finds before a
    prediction starts (see `momentum_observer.py`). No random numbers enter. Raises LogError.
    """
    judged = subject(model, arm)
    joint_types, logs = judged.model.joint_types, [logs] if isinstance(logs, Trajectory) else list(logs)
    for trajectory in logs:
        require_joints(trajectory, judged.joints)
    notes = check(logs, judged.joints, joint_types)
    notes += _seen(logs, judged)
    if has_servos(judged.model):
        return _replayed(judged, logs, notes)
    require_torques(logs)
    used = _preprocessing(preprocessing, judged, logs)
    pieces = used.pieces(logs, shortest=2)
    tests = JudgedLogs(pieces, used, judged.reach)
    lengths = horizon_lengths(tests, steps, seconds, notes)
    probe = tests.windows(judged.window, PROBED)
    scales = loss_scales(probe, joint_types)
    substeps = choose_substeps(judged.model, probe, scales, start=judged.substeps_per_sample)
    predictors = [of_dynamics(MODEL, judged.model, substeps)]
    arm_of_model = JudgedArm(judged.joints, judged.urdf, judged.run, probe, notes)
    for baseline in BASELINES:
        predictors += baseline.predictors(arm_of_model)
    for name, dynamics in (baselines or {}).items():
        predictors.append(of_accurate_dynamics(name, dynamics, probe))
    tip = _tip(judged, notes)
    position = None if tip is None else tip.position
    predicted = [
        predict(name, k, tests, predictors, joint_types, position, judged.window, notes)
        for name, k in lengths.items()
    ]
    longest = max(predicted, key=lambda x: x[0].steps)[1] if predicted else None
    moving = dynamics_samples(logs, preprocessing=used, reach=judged.reach)
    samples = [x for x in moving if len(x.q)]
    return Results(
        robot=judged.robot,
        joints=tuple(judged.joints),
        trajectories=tuple(x.name for x in logs),
        cutoff=used.cutoff or None,
        substeps=substeps,
        parameters=sum(parameter.numel() for parameter in judged.model.parameters()),
        horizons=tuple(horizon for horizon, _ in predicted),
        torque={
            x.name: torque_summary(torque_errors(x.dynamics, samples))
            for x in predictors
            if x.dynamics is not None and samples
        },
        energy_drift=energy_drift(judged.model, probe),
        traces=traces(predictors, pieces, longest, joint_types, used=used, reach=judged.reach, tip=position),
        diagnostics=tuple(notes),
        joint_types=tuple(joint_types),
    )  # fmt: skip


def _replayed(
    judged: Subject,
    logs: Sequence[Trajectory],
    notes: list[Diagnostic],
) -> Results:
    """Of an arm under position servos: its commands are replayed."""
    if any(x.u is None for x in logs):
        raise LogError(
            "logs without commanded positions",
            element=logs[0].name,
            expected="u: the model is one of position servos",
        )
    found, missed = replays(judged.model, logs, judged.command_followers, notes)
    return Results(
        robot=judged.robot, joints=tuple(judged.joints), trajectories=tuple(x.name for x in logs), cutoff=None,
        substeps=1, parameters=sum(x.numel() for x in judged.model.parameters()), horizons=(), torque={},
        energy_drift=None, replays=found, traces=replay_traces(missed), diagnostics=tuple(notes),
        joint_types=tuple(judged.model.joint_types),
    )  # fmt: skip


def _preprocessing(asked: Preprocessing | None, judged: Subject, logs: Sequence[Trajectory]) -> Preprocessing:
    if asked is None and judged.preprocessing is not None:
        return judged.preprocessing
    return (asked or Preprocessing()).resolved([x.sample_rate for x in logs])


def _seen(logs: Sequence[Trajectory], judged: Subject) -> list[Diagnostic]:
    """A warning when a trajectory of this name was trained on."""
    seen = [x.name for x in logs if x.name in judged.trained_on]
    if not seen:
        return []
    message = f"names also used in training: {', '.join(seen)}; errors on training data prove nothing"
    return [Diagnostic("warning", "tested-on-training-data", "logs", None, message)]


def _tip(judged: Subject, notes: list[Diagnostic]) -> TipKinematics | None:
    if judged.urdf is None:
        return None
    from spelgen.dynamics.tip import tip_kinematics  # slow to import

    try:
        return tip_kinematics(judged.urdf, judged.tip, joints=judged.joints)
    except Exception as error:  # as above, of pytorch-kinematics
        message = f"no tip errors: {_told(error)}"
        notes.append(Diagnostic("info", "no-tip", _where(judged.urdf), None, message))
        return None


def _where(urdf: Path | None) -> str:
    return "robot.urdf" if urdf is None else urdf.name


def _told(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
