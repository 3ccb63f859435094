"""Predictions of the motion in test logs over several horizons; all predictors start from the same samples.

A predictor is the trained model or a baseline.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from spelgen.baselines.predictor import Predictors, Solver, States
from spelgen.dynamics.bristles import BristleReach
from spelgen.dynamics.protocol import integrable, known_past, memory_along
from spelgen.errors import Diagnostic
from spelgen.evaluation.plain import finite
from spelgen.evaluation.tuning import TUNING
from spelgen.fitting.rollout import position_difference
from spelgen.labels import counted, observed
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows, joined


def past_steps(rate: float) -> int:
    """Return the number of sample intervals, before a prediction starts, that a momentum observer uses.

    rate: sample rate [Hz].
    """
    return max(1, round(TUNING.observed_past * rate))


def observe(dynamics: Any, windows: Windows, past: int) -> tuple[Windows, Tensor]:
    """Estimate a constant disturbance torque from the first `past` steps of W windows by a momentum observer.

        r(t) = K (p(t) - p(0) - integral from 0 to t of (G tau + C^T qd - g - friction + r)),    r(0) = 0

    (De Luca and Mattone, ICRA 2003, eq. 9; ICRA 2005). Here p = M qd is the momentum, G the input matrix, C the
    Coriolis matrix, g the gravity torque, and K [1/s] the gain of the observer. It follows that r' = K (d - r), with
    the residual d of the momentum balance: r is d after a first-order filter with time constant 1 / K. The prediction
    keeps r constant, as in offset-free control (Pannocchia and Rawlings, AIChE J. 49:426, 2003).

    Two details differ from the reference. First, d is assumed constant between samples, so that the filter has an exact
    solution. Second, r is divided by the step response of the filter, so that a constant disturbance is estimated
    without the delay of some time constants: r is a weighted mean of d.

    Args:
        dynamics: result of `integrable`.
        windows: windows of more than `past` steps.
        past: number of steps of the observer.

    Returns:
        The windows without their first `past` steps, and the disturbance (W, n): a generalised force [Nm, N] if the
        state of the dynamics contains momenta, an acceleration [rad/s^2, m/s^2] if the state contains velocities.
    """
    q = windows.q[:, : past + 1]
    qd = windows.qd[:, : past + 1]
    dt = windows.dt[:, :past].unsqueeze(-1)
    tau = windows.tau[:, :past]
    z = memory_along(dynamics, q, qd, windows.z)
    cache = dynamics.prepare()
    pose = dynamics.at(q, prepared=cache)
    p = dynamics.momentum(pose, qd)
    # The trapezoidal rule needs the right-hand side at both ends of each interval. The torque is constant in an
    # interval and jumps at a sample, so each sample is evaluated twice: with the torque of the interval that starts
    # there, and with the torque of the interval that ends there.
    inputs = torch.stack([torch.cat([tau, tau[:, -1:]], dim=1), torch.cat([tau[:, :1], tau], dim=1)])
    _, (at_start, at_end) = dynamics.port_hamiltonian_rhs(pose, p, inputs, cache, *known_past(dynamics, z))
    # `residual` is d of the docstring, the residual of the momentum balance in each of the `past` intervals before the
    # prediction, (W, past, n), in the unit of the result.
    residual = p.diff(dim=1) / dt - (at_start[:, :-1] + at_end[:, 1:]) / 2
    # The observer is a first-order filter, so its estimate is a weighted mean of `residual`. The weight of an interval
    # falls exponentially with the time from its end to the prediction; the sum of all weights is the step response.
    steps = dt / TUNING.observer_time_constant
    age = steps.sum(dim=1, keepdim=True) - steps.cumsum(dim=1)
    weight = (1 - torch.exp(-steps)) * torch.exp(-age)
    ahead = replace(without_past(windows, past), z=z[:, -1])
    return ahead, (weight * residual).sum(dim=1) / weight.sum(dim=1)


def without_past(windows: Windows, past: int) -> Windows:
    """Return the windows without their first `past` steps, the steps in which a momentum observer runs.

    The friction state z of the result is not updated: it is the state before these steps. `observe`, which has the
    dynamics of the friction state, replaces z.
    """
    dt, q, qd, tau = (column[:, past:] for column in (windows.dt, windows.q, windows.qd, windows.tau))
    return Windows(dt, q, qd, tau, windows.z)


TipPosition = Callable[[Tensor], Tensor]
"""Function that returns the position of the tip (..., 3) [m] at q (..., n) [rad, m]."""


@dataclass(frozen=True)
class StateErrors:
    """Root mean square (RMS) errors over all windows at the end of a horizon.

    An error is None if it is not finite. A tuple has one value per joint.

    Attributes:
        q: Position errors [rad, m]; revolute positions are compared modulo a revolution.
        qd: Velocity errors [rad/s, m/s].
        q_relative_rms: Position errors divided by the RMS change of q over the horizon.
        qd_relative_rms: Velocity errors divided by the RMS change of qd over the horizon.
        mean_relative_rms: Mean of the relative errors of q and qd of all joints.
        tip_mm: Position error of the tip [mm]; None also if the tip is unknown.
    """

    q: tuple[float | None, ...]
    qd: tuple[float | None, ...]
    q_relative_rms: tuple[float | None, ...]
    qd_relative_rms: tuple[float | None, ...]
    mean_relative_rms: float | None
    tip_mm: float | None


@dataclass(frozen=True)
class Horizon:
    """Errors of all predictors at one prediction horizon.

    steps: length [samples]. seconds: mean length [s], since sample intervals may vary. windows: number of predictions.
    errors: {key: RMS errors at the end of the horizon}. The key is the name of the predictor for open-loop predictions,
    and `observed(name)` for predictions with the disturbance that a momentum observer estimates.
    """

    name: str
    steps: int
    seconds: float
    windows: int
    errors: dict[str, StateErrors]


@dataclass(frozen=True, eq=False)
class EvaluatedLogs:
    """Test logs, cut at gaps and filtered.

    Attributes:
        pieces: Segments without gaps, from which windows are cut.
        samples: Filtered torques and accelerations of the logs whose sample rate is high enough to differentiate
            positions twice (see `dynamics_samples`).
        used: Preprocessing of the logs: filter and torque delay.
        reach: Break-away displacements of the K friction bristles of each joint, (n, K) [rad, m].
        joint_types: Types of the joints.
    """

    pieces: Sequence[Trajectory]
    samples: Sequence[DynamicsSamples]
    used: Preprocessing
    reach: BristleReach
    joint_types: Sequence[str]

    @property
    def rate(self) -> float:
        """Mean sample rate of the test logs [Hz]."""
        return sum(x.sample_rate for x in self.pieces) / len(self.pieces)

    @property
    def longest(self) -> int:
        """Length of the longest segment without gaps [steps between samples]."""
        return max(map(len, self.pieces)) - 1

    def stride(self, span: int, window_count: int) -> int:
        """Return the number of samples between the starts of consecutive windows of `span` steps.

        The stride is chosen so that the segments of all logs together contain about `window_count` windows.
        """
        return -(-sum(max(0, len(piece) - span) for piece in self.pieces) // window_count)

    def starts(self, span: int, window_count: int) -> list[tuple[Trajectory, int]]:
        """Return (segment, index of the first sample) of each of about `window_count` windows of `span` steps."""
        stride = self.stride(span, window_count)
        return [(piece, k) for piece in self.pieces for k in range(0, len(piece) - span, stride)]

    def windows(self, span: int, window_count: int) -> Windows:
        """Return about `window_count` windows of `span` steps; if no segment is as long, the windows are shorter."""
        span = min(span, self.longest)
        stride, measured = self.stride(span, window_count), self.used.filtered
        return cut_windows(self.pieces, span + 1, stride, measured=measured, reach=self.reach)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of all predictors for W windows of K samples.

    windows: measured motion. starts: (segment of a log, index of the first sample) of each window. states: {key: (q,
    qd)}, predicted positions and velocities at the samples after the first, (W, K-1, n) each [rad, m; rad/s, m/s]. The
    keys are the keys of `Horizon.errors`.
    """

    windows: Windows
    starts: list[tuple[Trajectory, int]]
    states: dict[str, States]


def horizon_lengths(
    logs: EvaluatedLogs, steps: Sequence[int], seconds: Sequence[float], notes: list[Diagnostic]
) -> dict[str, int]:
    """Return {name of a horizon, such as "1 s": length [samples]}.

    The horizons are given by `steps` [samples] and `seconds` [s]. A horizon that is longer than every trajectory is
    omitted, and a note is appended to `notes`.
    """
    lengths = {counted(k, "step"): k for k in steps}
    lengths |= {f"{duration:g} s": round(duration * logs.rate) for duration in seconds}
    possible = {}
    for name, k in lengths.items():
        if 0 < k <= logs.longest:
            possible[name] = k
            continue
        message = f"no prediction over {name}: the longest trajectory has {logs.longest} steps"
        notes.append(Diagnostic("info", "horizon-too-long", "logs", None, message))
    return possible


def predict(
    name: str,
    steps: int,
    logs: EvaluatedLogs,
    predictors: Predictors,
    tip: TipPosition | None,
    notes: list[Diagnostic],
) -> tuple[Horizon, Predictions]:
    """Return the errors of all predictors at a horizon of `steps` samples, and the predicted states.

    All predictors are evaluated in open loop. Predictors that integrate dynamics are evaluated a second time with a
    constant disturbance, which a momentum observer estimates from the samples before the prediction (see `observe`).

    Args:
        name: name of the horizon, such as "1 s".
        steps: length of the horizon [samples].
        logs: test logs.
        predictors: the model and the baselines.
        tip: position of the tip as a function of q; None if the tip is unknown.
        notes: list to which a note is appended if the logs are too short for the observer.
    """
    past = past_steps(logs.rate)
    # If no trajectory is long enough for the observer and the horizon, only open-loop predictions are evaluated.
    if past + steps > logs.longest:
        message = f"no observer over {name}: the longest trajectory has {logs.longest} steps"
        notes.append(Diagnostic("info", "no-observer", "logs", None, message))
        past = 0
    # Long rollouts have fewer windows, as the cost of a rollout is proportional to its number of steps.
    window_count = max(TUNING.fewest_windows, min(TUNING.most_windows, TUNING.most_predicted_steps // steps))
    windows = logs.windows(past + steps, window_count)
    ahead = without_past(windows, past)
    states = {}
    # The open-loop rollout and the rollout with the observed disturbance start from the same friction state, the state
    # at the end of the observer's steps.
    for predictor, solver in predictors.items():
        if not past or not isinstance(solver, Solver):
            states[predictor] = solver(ahead)
            continue
        with torch.no_grad():
            started, disturbance = observe(integrable(solver.dynamics), windows, past)
        # The rollouts without and with the disturbance form one batch: two batches would need twice the number of calls
        # of torch.
        disturbances = torch.cat([torch.zeros_like(disturbance), disturbance])
        q, qd = solver(joined([started, started]), disturbances)
        count = len(started)
        states[predictor] = q[:count], qd[:count]
        states[observed(predictor)] = q[count:], qd[count:]
    errors = {name: end_errors(state, ahead, logs.joint_types, tip) for name, state in states.items()}
    seconds = ahead.dt.sum(dim=1).mean().item()
    starts = [(piece, first + past) for piece, first in logs.starts(past + steps, window_count)]
    return Horizon(name, steps, seconds, len(ahead), errors), Predictions(ahead, starts, states)


def end_errors(
    states: States, windows: Windows, joint_types: Sequence[str], tip: TipPosition | None
) -> StateErrors:
    """Return the errors of a prediction at the last sample of W windows of K samples.

    Args:
        states: predicted q [rad, m] and qd [rad/s, m/s] at the samples after the first, (W, K-1, n) each.
        windows: measured motion.
        joint_types: "revolute" or "prismatic" for each joint.
        tip: position of the tip as a function of q; None if the tip is unknown.
    """
    q, qd = (predicted[:, -1] for predicted in states)  # predicted q and qd: (W, n) each
    measured_q, measured_qd = windows.q[:, -1], windows.qd[:, -1]
    # Angles of revolute joints are compared modulo a revolution. The RMS is used instead of the mean absolute error,
    # since large errors decide whether a simulation is usable.
    q_error = _rms(position_difference(q, measured_q, joint_types))
    qd_error = _rms(qd - measured_qd)
    # Errors are divided by the RMS change of q and qd over the horizon, so that joints and horizons can be compared.
    q_relative = q_error / _rms(position_difference(measured_q, windows.q[:, 0], joint_types))
    qd_relative = qd_error / _rms(measured_qd - windows.qd[:, 0])
    mean = torch.cat([q_relative, qd_relative]).mean(dim=0, keepdim=True)
    tip_mm = None
    if tip is not None:
        distance = _rms((tip(q) - tip(measured_q)).norm(dim=-1, keepdim=True))
        (tip_mm,) = finite(1000 * distance)
    of_q, of_qd, relative_q, relative_qd = map(finite, (q_error, qd_error, q_relative, qd_relative))
    return StateErrors(of_q, of_qd, relative_q, relative_qd, finite(mean)[0], tip_mm)


def _rms(values: Tensor) -> Tensor:
    """Return the root mean square over W windows of values (W, ...), an array of shape (...)."""
    return values.square().mean(dim=0).sqrt()
