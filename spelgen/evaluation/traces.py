"""The curves behind the figures of an evaluation: for pages, and for programs as `traces` of evaluation.json.

All are arrays [rad, m, s, Nm, N, kg m^2, J], NaN where a number is not known; JSON has them to five digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spelgen.baselines.names import MODEL, is_drawn
from spelgen.baselines.predictor import Predictor
from spelgen.baselines.solver import States
from spelgen.evaluation.horizons import JudgedLogs, Predictions
from spelgen.evaluation.plain import Curve, number
from spelgen.evaluation.replay import Missed
from spelgen.evaluation.state_errors import TipPosition
from spelgen.evaluation.torque_traces import TorqueTrace, torque_traces, typical_and_worst
from spelgen.fitting.rollout import AT_REST, LossScales, loss_scales, position_difference
from spelgen.logs.coverage import coverage
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows
from spelgen.settings.tuning.evaluation import TraceTuning

if TYPE_CHECKING:
    from spelgen.dynamics.protocol import RigidDynamics

TUNING = TraceTuning()


@dataclass(frozen=True, eq=False)
class Quantiles:
    """10, 50 and 90 % of the starts have at most these errors, by time."""

    low: Curve
    median: Curve
    high: Curve


@dataclass(frozen=True, eq=False)
class Growth:
    """How errors grow with time [s], by predictor: relative to the motion, and of the tip [mm] where it is known."""

    seconds: Curve
    windows: int
    relative: dict[str, Quantiles]
    tip_mm: dict[str, Quantiles]


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedMotion:
    """Hold a piece of a trajectory, measured and predicted, (T, n); t counts from its first sample [s].

    u: commands of position servos, whose velocities are not judged.
    """

    t: Curve
    q: Curve
    predicted_q: Curve
    qd: Curve | None = None
    predicted_qd: Curve | None = None
    u: Curve | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictedExample(PredictedMotion):
    """Hold a prediction of the model, of middle ("typical") or largest ("worst") error, that starts at this time [s].

    start: None of a log that is replayed as a whole.
    """

    which: str
    trajectory: str
    error: float | None
    start: float | None = None


@dataclass(frozen=True, eq=False)
class MassCurves:
    """The lower triangle of M, row by row, and its eigenvalues along a trajectory; (entries, T) and (n, T)."""

    entries: Curve
    eigenvalues: Curve


@dataclass(frozen=True, eq=False)
class MassTrace:
    """M along a trajectory by predictor."""

    trajectory: str
    t: Curve
    by: dict[str, MassCurves]


@dataclass(frozen=True, eq=False)
class FrictionTrace:
    """Friction by velocity: (n, T) by predictor, each joint alone at the mean position."""

    qd: Curve
    by: dict[str, Curve]


@dataclass(frozen=True, eq=False)
class Traces:
    """All curves; coverage: of the test logs, see `logs.coverage`."""

    coverage: dict[str, object]
    growth: Growth | None = None
    trajectories: tuple[PredictedExample, ...] = ()
    torques: tuple[TorqueTrace, ...] = ()
    mass: MassTrace | None = None
    friction: FrictionTrace | None = None


def motion_traces(
    predictors: Sequence[Predictor],
    logs: JudgedLogs,
    predictions: Predictions | None,
    tip: TipPosition | None,
) -> Traces:
    """Return all curves of an arm under torques. predictions: over the longest horizon."""
    dynamics = {x.name: x.dynamics for x in predictors if x.dynamics is not None}
    growth: Growth | None = None
    examples: tuple[PredictedExample, ...] = ()
    # errors are relative to the motion: there is none at rest
    if predictions is not None and predictions.windows.q.diff(dim=1).abs().max() >= AT_REST:
        growth = _growth(predictions, logs.joint_types, tip)
        examples = _examples(predictions, logs.joint_types)
    torques = torque_traces(dynamics, logs)
    return Traces(
        coverage=coverage(logs.pieces),
        growth=growth,
        trajectories=examples,
        torques=torques,
        mass=_mass_trace(dynamics, (*torques, *examples)),
        friction=_friction_trace(dynamics, logs.pieces),
    )


def replay_traces(missed: Sequence[Missed]) -> Traces:
    """Return the logs of middle and of largest error of an arm under position servos."""
    errors = [float(np.sqrt(np.square(error).mean())) for _, error in missed]
    examples = []
    for which, k in typical_and_worst(errors).items():
        log, error = missed[k]
        assert log.u is not None  # a log without commands cannot be replayed
        stride = -(-len(log) // TUNING.log_samples)
        predicted = np.concatenate([log.q[:1], log.q[1:] + error])
        example = PredictedExample(
            which=which,
            trajectory=log.name,
            error=number(errors[k]),
            t=(log.t - log.t[0])[::stride],
            q=log.q[::stride],
            u=log.u[::stride],
            predicted_q=predicted[::stride],
        )
        examples.append(example)
    return Traces(coverage([log for log, _ in missed]), trajectories=tuple(examples))


def _growth(predictions: Predictions, joint_types: Sequence[str], tip: TipPosition | None) -> Growth:
    windows = predictions.windows
    steps = windows.dt.shape[1]
    # errors grow by orders of magnitude: as many points for the first tenth as for the last
    times = np.unique(np.geomspace(1, steps, TUNING.times).round().astype(int)) - 1
    scales = loss_scales(windows, joint_types)
    relative, tips = {}, {}
    for name, states in predictions.states.items():
        if not is_drawn(name):
            continue
        errors = _relative_errors(states, windows, scales, joint_types)
        relative[name] = _quantiles(errors[:, times])
        if tip is not None:
            measured = tip(windows.q[:, 1:][:, times])
            tips[name] = _quantiles(1000 * (tip(states[0][:, times]) - measured).norm(dim=-1))
    seconds = windows.dt.cumsum(dim=1).mean(dim=0)[times]
    return Growth(seconds.numpy(), len(windows), relative, tips)


def _relative_errors(
    states: States, windows: Windows, scales: LossScales, joint_types: Sequence[str]
) -> Tensor:
    """Return the root mean square over joints of errors in units of the motion, (W, K-1)."""
    q, qd = states
    position = position_difference(q, windows.q[:, 1:], joint_types) / scales.q
    velocity = (qd - windows.qd[:, 1:]) / scales.qd
    return torch.cat([position, velocity], dim=-1).square().mean(dim=-1).sqrt()


def _quantiles(values: Tensor) -> Quantiles:
    """Return those over windows of (W, T); what is not finite counts as infinite."""
    ordered = values.nan_to_num(nan=torch.inf).sort(dim=0).values.numpy()
    last = len(ordered) - 1
    return Quantiles(*(ordered[round(part * last)] for part in (0.1, 0.5, 0.9)))


def _examples(predictions: Predictions, joint_types: Sequence[str]) -> tuple[PredictedExample, ...]:
    windows, states = predictions.windows, predictions.states[MODEL]
    errors = _relative_errors(states, windows, loss_scales(windows, joint_types), joint_types)[:, -1].tolist()
    stride = -(-windows.dt.shape[1] // TUNING.samples)
    examples = []
    for which, k in typical_and_worst(errors).items():
        piece, first = predictions.starts[k]
        motion = predicted_motion(windows, states, k, stride)
        examples.append(
            PredictedExample(
                **vars(motion),
                which=which,
                trajectory=piece.name,
                start=number(piece.t[first] - piece.t[0]),
                error=number(errors[k]),
            )
        )
    return tuple(examples)


def predicted_motion(windows: Windows, states: States, k: int = 0, stride: int = 1) -> PredictedMotion:
    """Return window k with what was predicted of it."""
    predicted_q, predicted_qd = states
    return PredictedMotion(
        t=torch.cat([windows.dt.new_zeros(1), windows.dt[k].cumsum(dim=0)])[::stride].numpy(),
        q=windows.q[k][::stride].numpy(),
        qd=windows.qd[k][::stride].numpy(),
        predicted_q=torch.cat([windows.q[k, :1], predicted_q[k]])[::stride].numpy(),
        predicted_qd=torch.cat([windows.qd[k, :1], predicted_qd[k]])[::stride].numpy(),
    )


def _mass_trace(
    dynamics: Mapping[str, RigidDynamics], trajectories: Sequence[TorqueTrace | PredictedExample]
) -> MassTrace | None:
    """Return M along the first trajectory that is drawn."""
    if not trajectories:
        return None
    along = trajectories[0]
    stride = -(-len(along.t) // TUNING.samples)
    q = torch.from_numpy(along.q[::stride].copy())
    row, column = np.tril_indices(q.shape[-1])
    curves = {}
    for name, predictor in dynamics.items():
        with torch.no_grad():
            mass = torch.as_tensor(predictor.mass_matrix(q)).numpy()
        if np.isfinite(mass).all():  # else it has no eigenvalues
            curves[name] = MassCurves(mass[:, row, column].T, np.linalg.eigvalsh(mass).T)
    return MassTrace(along.trajectory, along.t[::stride], curves)


def _friction_trace(dynamics: Mapping[str, RigidDynamics], pieces: Sequence[Trajectory]) -> FrictionTrace:
    q = np.concatenate([piece.q for piece in pieces])
    fast = np.quantile(np.abs(np.concatenate([piece.qd for piece in pieces])), 0.995, axis=0)
    middle = torch.from_numpy(q.mean(axis=0))
    n = len(middle)
    grid = np.sinh(np.linspace(-4, 4, 81)) / np.sinh(4)  # dense where friction turns around
    # the fastest samples are often spikes of differenced positions
    speeds = torch.from_numpy(grid[:, None] * fast)  # (81, n)
    curves = {}
    for name, predictor in dynamics.items():
        with torch.no_grad():
            alone = torch.diag_embed(speeds)  # one joint at a time
            torque = torch.as_tensor(predictor.friction_torque(middle.expand(len(speeds), n, n), alone))
        curves[name] = torch.diagonal(torque, dim1=-2, dim2=-1).mT.numpy()
    return FrictionTrace(speeds.mT.numpy(), curves)
