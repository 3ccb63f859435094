"""Judge a model on test logs, beside its baselines, on the same windows and with the same integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spelgen.dynamics.protocol import RigidDynamics
from spelgen.errors import Diagnostic
from spelgen.evaluation.baselines import (
    Predictor,
    constant_velocity,
    of_baseline,
    of_dynamics,
    of_urdf,
)
from spelgen.evaluation.invariants import energy_drift
from spelgen.evaluation.names import MODEL
from spelgen.evaluation.results import Horizon, Results, state_errors, torque_summary
from spelgen.evaluation.subject import Subject, subject
from spelgen.evaluation.torque import torque_errors
from spelgen.evaluation.traces import traces
from spelgen.fitting.rollout import choose_substeps, loss_scales
from spelgen.identification.samples import dynamics_samples
from spelgen.logs.checks import check
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints
from spelgen.logs.windows import Windows, cut_windows

if TYPE_CHECKING:
    from spelgen.dynamics.tip import TipKinematics

PREDICTED_STEPS = 40_000  # per horizon and predictor: windows are thinned evenly to about this many
MOST_WINDOWS = 2000
PROBED = 64  # windows that say how many steps the integrator needs


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
    the fit's: it gives the URDF as a baseline, and errors of the tip. baselines: any dynamics to be judged beside
    it, by name, e.g. ``{"least squares": identify(...).dynamics}``. preprocessing: of states and torques; by
    default as the model was fitted. steps, seconds: horizons in samples and in time; those longer than every
    trajectory are left out, and said. The result depends on nothing else: no random numbers. Raises LogError.
    """
    judged = subject(model, arm)
    joint_types, logs = judged.model.joint_types, [logs] if isinstance(logs, Trajectory) else list(logs)
    for trajectory in logs:
        require_joints(trajectory, judged.joints)
    notes = check(logs, judged.joints, joint_types)
    notes += _seen(logs, judged)
    used = _preprocessing(preprocessing, judged, logs)
    pieces = used.pieces(logs, shortest=2)
    lengths = _lengths(pieces, steps, seconds, notes)
    probe = _windows(pieces, judged.window, PROBED, used, judged.reach)
    substeps = choose_substeps(judged.model, probe, loss_scales(probe, joint_types), start=judged.substeps)
    predictors = [of_dynamics(MODEL, judged.model, substeps), constant_velocity()]
    predictors += _urdf_baseline(judged, probe, notes)
    predictors += [of_baseline(name, each, probe) for name, each in (baselines or {}).items()]
    tip = _tip(judged, notes)
    samples = dynamics_samples(logs, preprocessing=used, reach=judged.reach)
    return Results(
        robot=judged.robot,
        joints=tuple(judged.joints),
        trajectories=tuple(x.name for x in logs),
        cutoff=used.cutoff or None,
        substeps=substeps,
        parameters=sum(parameter.numel() for parameter in judged.model.parameters()),
        horizons=tuple(
            _horizon(name, k, pieces, predictors, judged, tip, used) for name, k in lengths.items()
        ),
        torque={
            x.name: torque_summary(torque_errors(x.torque, samples))
            for x in predictors
            if x.torque and samples
        },
        energy_drift=energy_drift(judged.model, probe),
        traces=traces(
            predictors, pieces, max(lengths.values(), default=0), joint_types,
            used=used, reach=judged.reach, tip=None if tip is None else tip.position,
        ),
        diagnostics=tuple(notes),
        joint_types=tuple(joint_types),
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


def _lengths(
    pieces: Sequence[Trajectory], steps: Sequence[int], seconds: Sequence[float], notes: list[Diagnostic]
) -> dict[str, int]:
    """Horizon name -> number of samples ahead."""
    frequency = sum(x.sample_rate for x in pieces) / len(pieces)
    wanted = {f"{k} step{'s' if k > 1 else ''}": k for k in steps}
    wanted |= {f"{duration:g} s": round(duration * frequency) for duration in seconds}
    longest = max(map(len, pieces)) - 1
    for name, k in wanted.items():
        if not 0 < k <= longest:
            message = f"no prediction over {name}: the longest trajectory has {longest} steps"
            notes.append(Diagnostic("info", "horizon-too-long", "logs", None, message))
    return {name: k for name, k in wanted.items() if 0 < k <= longest}


def _windows(
    pieces: Sequence[Trajectory], samples: int, most: int, used: Preprocessing, reach: np.ndarray
) -> Windows:
    """About `most` windows, or all, evenly spread."""
    samples = min(samples, max(map(len, pieces)))
    starts = sum(max(0, len(x) - samples + 1) for x in pieces)
    return cut_windows(pieces, samples, -(-starts // most), measured=used.filtered, reach=reach)


def _horizon(
    name: str,
    steps: int,
    pieces: Sequence[Trajectory],
    predictors: Sequence[Predictor],
    judged: Subject,
    tip: TipKinematics | None,
    used: Preprocessing,
) -> Horizon:
    most = min(MOST_WINDOWS, PREDICTED_STEPS // steps)
    windows = _windows(pieces, steps + 1, max(most, 1), used, judged.reach)
    position = None if tip is None else tip.position
    errors = {x.name: state_errors(x, windows, judged.model.joint_types, position) for x in predictors}
    return Horizon(name, steps, windows.dt.sum(dim=1).mean().item(), len(windows), errors)


def _urdf_baseline(judged: Subject, probe: Windows, notes: list[Diagnostic]) -> list[Predictor]:
    """The URDF's own values as a baseline, where they can be had."""
    if judged.urdf is None:
        reason = "no arm is known"
    else:
        try:
            return of_urdf(judged.urdf, judged.joints, probe)
        except Exception as error:  # Pinocchio and its parser raise many kinds; the evaluation stands without
            reason = _told(error)
    message = f"no comparison with the URDF: {reason}"
    notes.append(Diagnostic("info", "no-urdf-baseline", _where(judged.urdf), None, message))
    return []


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
