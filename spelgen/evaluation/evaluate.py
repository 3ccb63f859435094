"""Judge a model on test logs, beside its baselines, on the same windows and with the same integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from spelgen.dynamics.bristles import BristleReach
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.errors import Diagnostic
from spelgen.evaluation.baselines import (
    Predictor,
    constant_velocity,
    of_baseline,
    of_dynamics,
    of_urdf,
)
from spelgen.evaluation.disturbance import without_past
from spelgen.evaluation.forecast import (
    Disturbance,
    Forecast,
    for_calibration,
    forecast_of,
    past_steps,
    rolled,
)
from spelgen.evaluation.invariants import energy_drift
from spelgen.evaluation.names import MODEL
from spelgen.evaluation.results import (
    Horizon,
    Results,
    end_errors,
    forecast_summary,
    state_errors,
    torque_summary,
)
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
    disturbance: Disturbance = "held",
) -> Results:
    """Predict the states and torques of test logs and measure the errors.

    model: an emitted one, a fit, or the folder of a run. arm: of ``load_arm``, or the path of a URDF; by default
    the fit's: it gives the URDF as a baseline, and errors of the tip. baselines: any dynamics to be judged beside
    it, by name, e.g. ``{"least squares": identify(...).dynamics}``. preprocessing: of states and torques; by
    default as the model was fitted. steps, seconds: horizons in samples and in time; those longer than every
    trajectory are left out, and said. disturbance: "held" judges forecasts (see `forecast.py`) where the model comes
    with windows of its training logs; "none" rollouts by themselves, open loop. The result depends on nothing else:
    no random numbers. Raises LogError.
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
    scales = loss_scales(probe, joint_types)
    substeps = choose_substeps(judged.model, probe, scales, start=judged.substeps_per_sample)
    predictors = [of_dynamics(MODEL, judged.model, substeps), constant_velocity()]
    predictors += _urdf_baseline(judged, probe, notes)
    predictors += [of_baseline(name, each, probe) for name, each in (baselines or {}).items()]
    forecasts = _forecasts(predictors, judged, notes) if disturbance == "held" else {}
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
            _horizon(name, k, pieces, predictors, forecasts, judged, tip, used, notes)
            for name, k in lengths.items()
        ),
        torque={
            x.name: torque_summary(torque_errors(x.torque, samples))
            for x in predictors
            if x.torque and samples
        },
        energy_drift=energy_drift(judged.model, probe),
        forecasts={name: forecast_summary(x.trust) for name, x in forecasts.items()},
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
    frequency = _rate(pieces)
    wanted = {f"{k} step{'s' if k > 1 else ''}": k for k in steps}
    wanted |= {f"{duration:g} s": round(duration * frequency) for duration in seconds}
    longest = max(map(len, pieces)) - 1
    for name, k in wanted.items():
        if not 0 < k <= longest:
            message = f"no prediction over {name}: the longest trajectory has {longest} steps"
            notes.append(Diagnostic("info", "horizon-too-long", "logs", None, message))
    return {name: k for name, k in wanted.items() if 0 < k <= longest}


def _rate(pieces: Sequence[Trajectory]) -> float:
    return sum(x.sample_rate for x in pieces) / len(pieces)


def _windows(
    pieces: Sequence[Trajectory], samples: int, most: int, used: Preprocessing, reach: BristleReach
) -> Windows:
    """About `most` windows, or all, evenly spread."""
    samples = min(samples, max(map(len, pieces)))
    starts = sum(max(0, len(x) - samples + 1) for x in pieces)
    return cut_windows(pieces, samples, -(-starts // most), measured=used.filtered, reach=reach)


def _forecasts(
    predictors: Sequence[Predictor], judged: Subject, notes: list[Diagnostic]
) -> dict[str, Forecast]:
    """Of all that have dynamics, by the same training windows; none where these are not known."""
    calibration, types = judged.calibration, judged.model.joint_types
    dynamic = [x for x in predictors if x.form is not None]
    if calibration is not None:
        found = {x.name: forecast_of(for_calibration(x, calibration), calibration, types) for x in dynamic}
        known = {name: each for name, each in found.items() if each is not None}
        if known:
            return known
    reason = (
        "no windows of its training logs are known" if calibration is None else "its training logs are short"
    )
    notes.append(_open_loop(f"no forecasts, rollouts are open loop: {reason}"))
    return {}


def _open_loop(message: str) -> Diagnostic:
    return Diagnostic("info", "open-loop", "logs", None, message)


def _horizon(
    name: str,
    steps: int,
    pieces: Sequence[Trajectory],
    predictors: Sequence[Predictor],
    forecasts: Mapping[str, Forecast],
    judged: Subject,
    tip: TipKinematics | None,
    used: Preprocessing,
    notes: list[Diagnostic],
) -> Horizon:
    """Errors over so many steps: of forecasts, where these reach that far and pieces are long enough for a past."""
    most, rate = max(min(MOST_WINDOWS, PREDICTED_STEPS // steps), 1), _rate(pieces)
    past = past_steps(rate)
    reached = all(x.trust.reaches(steps / rate) for x in forecasts.values())
    if not forecasts or not reached or past + steps >= max(map(len, pieces)):
        past = 0
    if forecasts and not past:
        reason = "these trajectories have no past" if reached else "windows of its training logs are shorter"
        notes.append(_open_loop(f"no forecasts over {name}, rollouts are open loop: {reason}"))
    windows = _windows(pieces, past + steps + 1, most, used, judged.reach)
    types, position = judged.model.joint_types, None if tip is None else tip.position
    errors, open_loop = {}, {}
    for predictor in predictors:
        forecast = forecasts.get(predictor.name)
        if past and forecast is not None:
            found = rolled(predictor, windows, past)
            q, qd = torch.from_numpy(found.open_loop)
            open_loop[predictor.name] = end_errors((q, qd), found.ahead, types, position)
            errors[predictor.name] = end_errors(forecast.states(found), found.ahead, types, position)
            continue
        errors[predictor.name] = state_errors(predictor, without_past(windows, past), types, position)
        if past:
            open_loop[predictor.name] = errors[predictor.name]
    ahead = windows.dt[:, past:].sum(dim=1).mean().item()
    return Horizon(name, steps, ahead, len(windows), errors, open_loop)


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
