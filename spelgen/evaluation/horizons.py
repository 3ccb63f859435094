"""Predictions of test logs some samples or seconds ahead, by all predictors from the same starting points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from spelgen.baselines.predictor import Predictor, Solver, States
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
    """Return the number of steps of the observer before a prediction, at a sample rate [Hz]."""
    return max(1, round(TUNING.observed_past * rate))


def observe(dynamics: Any, windows: Windows, past: int) -> tuple[Windows, Tensor]:
    """Observe the disturbance torque in the first `past` steps of W windows: causal, without accelerations.

        r(t) = K (p(t) - p(0) - integral from 0 to t of (G tau + C^T qd - g - friction + r)),    r(0) = 0

    (De Luca and Mattone, ICRA 2003, eq. 9; ICRA 2005), so that r' = K (d - r), with d the residual of the momentum
    balance: r is d after a first-order filter with time constant 1 / K. A prediction then keeps r constant, as
    offset-free control does (Pannocchia and Rawlings, AIChE J. 49:426, 2003).

    Two differences from the reference: d is constant between samples, so that the filter is solved exactly; and r is
    divided by the response of the filter to d = 1, so that a constant disturbance is found at once instead of after
    some time constants.

    Args:
        dynamics: of `integrable`.
        windows: of more than `past` steps.
        past: number of steps of the observer.

    Returns:
        The windows without these steps, and the disturbance (W, n): a generalised force [Nm, N] if the state of the
        dynamics has momenta, an acceleration [rad/s^2, m/s^2] if it has velocities.
    """
    q = windows.q[:, : past + 1]
    qd = windows.qd[:, : past + 1]
    dt = windows.dt[:, :past].unsqueeze(-1)
    tau = windows.tau[:, :past]
    z = memory_along(dynamics, q, qd, windows.z)
    cache = dynamics.prepare()
    pose = dynamics.at(q, prepared=cache)
    p = dynamics.momentum(pose, qd)
    # the input is constant in each interval: at a sample, it has the values of the intervals after and before it
    inputs = torch.stack([torch.cat([tau, tau[:, -1:]], dim=1), torch.cat([tau[:, :1], tau], dim=1)])
    _, (at_start, at_end) = dynamics.port_hamiltonian_rhs(pose, p, inputs, cache, *known_past(dynamics, z))
    residual = p.diff(dim=1) / dt - (at_start[:, :-1] + at_end[:, 1:]) / 2  # d in each interval, (W, past, n)
    gain = 1 - torch.exp(-dt / TUNING.observer_time_constant)
    r = torch.zeros_like(residual[:, 0])
    response = torch.zeros_like(gain[:, 0])  # response of the filter to d = 1
    for k in range(past):
        r = r + gain[:, k] * (residual[:, k] - r)
        response = response + gain[:, k] * (1 - response)
    ahead = replace(without_past(windows, past), z=z[:, -1])
    return ahead, r / response


def without_past(windows: Windows, past: int) -> Windows:
    """Return the windows without their first `past` steps; z remains the state at the first sample."""
    dt, q, qd, tau = (column[:, past:] for column in (windows.dt, windows.q, windows.qd, windows.tau))
    return Windows(dt, q, qd, tau, windows.z)


TipPosition = Callable[[Tensor], Tensor]
"""Return the position of the tip (..., 3) [m] at q (..., n) [rad, m]."""


@dataclass(frozen=True)
class StateErrors:
    """Errors at the end of a horizon, root mean square (RMS) over windows, per joint where a tuple.

    q, qd: [rad, rad/s; m, m/s], revolute positions as angles on the circle. q_relative_rms, qd_relative_rms:
    divided by the RMS change of q and qd over the horizon. mean_relative_rms: mean of both over all joints. tip_mm:
    distance of the tip [mm]. None: not finite, or unknown.
    """

    q: tuple[float | None, ...]
    qd: tuple[float | None, ...]
    q_relative_rms: tuple[float | None, ...]
    qd_relative_rms: tuple[float | None, ...]
    mean_relative_rms: float | None
    tip_mm: float | None


@dataclass(frozen=True)
class Horizon:
    """Errors of predictions some samples ahead.

    steps: number of samples. seconds: mean length [s]. windows: number of predictions. errors: by predictor, open
    loop, and by `observed(predictor)` with the disturbance that a momentum observer estimates.
    """

    name: str
    steps: int
    seconds: float
    windows: int
    errors: dict[str, StateErrors]


@dataclass(frozen=True, eq=False)
class EvaluatedLogs:
    """Test logs, cut at gaps and filtered.

    pieces: segments without gaps, from which windows are cut. samples: torques and accelerations of dense logs,
    see `dynamics_samples`. used: the preprocessing. reach: break-away displacement of the bristles of friction.
    """

    pieces: Sequence[Trajectory]
    samples: Sequence[DynamicsSamples]
    used: Preprocessing
    reach: BristleReach
    joint_types: Sequence[str]

    @property
    def rate(self) -> float:
        """Mean sample rate [Hz]."""
        return sum(x.sample_rate for x in self.pieces) / len(self.pieces)

    @property
    def longest(self) -> int:
        """Number of steps of the longest piece."""
        return max(map(len, self.pieces)) - 1

    def stride(self, span: int, window_count: int) -> int:
        """Return the samples between the starts of windows of `span` steps, for about `window_count` windows."""
        return -(-sum(max(0, len(piece) - span) for piece in self.pieces) // window_count)

    def starts(self, span: int, window_count: int) -> list[tuple[Trajectory, int]]:
        """Return the piece and the first sample of each of these windows."""
        stride = self.stride(span, window_count)
        return [(piece, k) for piece in self.pieces for k in range(0, len(piece) - span, stride)]

    def windows(self, span: int, window_count: int) -> Windows:
        """Return these windows; they are shorter than `span` if all pieces are."""
        span = min(span, self.longest)
        stride, measured = self.stride(span, window_count), self.used.filtered
        return cut_windows(self.pieces, span + 1, stride, measured=measured, reach=self.reach)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predictions of W windows. starts: piece and first sample of each. states: q and qd (W, K-1, n) by predictor."""

    windows: Windows
    starts: list[tuple[Trajectory, int]]
    states: dict[str, States]


def horizon_lengths(
    logs: EvaluatedLogs, steps: Sequence[int], seconds: Sequence[float], notes: list[Diagnostic]
) -> dict[str, int]:
    """Return the number of samples of each horizon by name; longer ones than every trajectory are noted instead."""
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
    predictors: Sequence[Predictor],
    tip: TipPosition | None,
    notes: list[Diagnostic],
) -> tuple[Horizon, Predictions]:
    """Evaluate rollouts of `steps` samples: open loop, and with the disturbance observed before they start."""
    past = past_steps(logs.rate)
    # without room for the past, the open-loop prediction is still evaluated
    if past + steps > logs.longest:
        message = f"no observer over {name}: the longest trajectory has {logs.longest} steps"
        notes.append(Diagnostic("info", "no-observer", "logs", None, message))
        past = 0
    # the cost of a rollout is proportional to its steps
    window_count = max(TUNING.fewest_windows, min(TUNING.most_windows, TUNING.most_predicted_steps // steps))
    windows = logs.windows(past + steps, window_count)
    ahead = without_past(windows, past)
    states = {}
    # both rollouts of a predictor start from the friction state at the end of the observed past
    for predictor in predictors:
        if not past or not isinstance(predictor.solver, Solver):
            states[predictor.name] = predictor.solver(ahead)
            continue
        with torch.no_grad():
            started, disturbance = observe(integrable(predictor.solver.dynamics), windows, past)
        # one batch of both rollouts needs half as many operations
        disturbances = torch.cat([torch.zeros_like(disturbance), disturbance])
        q, qd = predictor.solver(joined([started, started]), disturbances)
        count = len(started)
        states[predictor.name] = q[:count], qd[:count]
        states[observed(predictor.name)] = q[count:], qd[count:]
    errors = {name: end_errors(state, ahead, logs.joint_types, tip) for name, state in states.items()}
    seconds = ahead.dt.sum(dim=1).mean().item()
    starts = [(piece, first + past) for piece, first in logs.starts(past + steps, window_count)]
    return Horizon(name, steps, seconds, len(ahead), errors), Predictions(ahead, starts, states)


def end_errors(
    states: States, windows: Windows, joint_types: Sequence[str], tip: TipPosition | None
) -> StateErrors:
    """Return the errors at the end of each window. states: predicted q and qd (W, K-1, n)."""
    q, qd = (predicted[:, -1] for predicted in states)  # (W, n)
    measured_q, measured_qd = windows.q[:, -1], windows.qd[:, -1]
    # angles of revolute joints are compared modulo a revolution
    # root mean square and not the mean: large errors decide whether a simulation can be used
    q_error = _rms(position_difference(q, measured_q, joint_types))
    qd_error = _rms(qd - measured_qd)
    # relative to the motion, so that joints and horizons can be compared
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
    """Return the root mean square over windows, (W, ...) -> (...)."""
    return values.square().mean(dim=0).sqrt()
