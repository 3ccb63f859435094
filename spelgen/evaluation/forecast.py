"""Forecasts: extrapolated motion, and rollouts with the past disturbance held as far as training trusts them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from spelgen.evaluation.baselines import Predictor, constant_velocity, of_baseline, of_dynamics
from spelgen.evaluation.disturbance import after_past, without_past
from spelgen.evaluation.extrapolation import Extrapolation, extrapolation
from spelgen.evaluation.names import MODEL
from spelgen.evaluation.stiff import States
from spelgen.evaluation.trust import LEAST_BLOCKS, TIMES, Trust, calibrated
from spelgen.fitting.calibration import PAST, CalibrationWindows
from spelgen.fitting.rollout import choose_substeps, loss_scales, position_difference
from spelgen.logs.windows import Windows, joined

PARTS = 32  # that windows are predicted in where some blow up
Disturbance = Literal["held", "none"]


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Predictions of windows after their past, (2, W, K-1, n), of q and qd.

    ahead: what they predict. still: at constant velocity. open_loop, held: by dynamics without and with the
    disturbance. qd, change: (W, n) the velocity at the start and its change over the past.
    """

    ahead: Windows
    still: np.ndarray
    open_loop: np.ndarray
    held: np.ndarray
    qd: np.ndarray
    change: np.ndarray

    @property
    def times(self) -> np.ndarray:
        """Ahead (K-1,) [s]."""
        return _elapsed(self.ahead)


@dataclass(frozen=True, eq=False)
class TrainingMotion:
    """How training windows went on, at times (T,) [s], which are samples `chosen` (T,) ahead.

    going_on: (2, W, T, n) extrapolated q and qd. measured: (2, W, T, n) how measured ones differ from these.
    """

    calibration: CalibrationWindows
    chosen: np.ndarray
    times: np.ndarray
    extrapolation: Extrapolation
    going_on: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True, eq=False)
class Forecast:
    """What a predictor's rollouts are worth beside motion that goes on."""

    extrapolation: Extrapolation
    trust: Trust

    def states(self, rollouts: Rollouts) -> States:
        """q and qd, (W, K-1, n), for what these rollouts predict."""
        on = self._going_on(rollouts)
        added = self.trust.added(rollouts.open_loop - on, rollouts.held - on, rollouts.times)
        q, qd = torch.from_numpy(on + added)
        return q, qd

    def going_on(self, rollouts: Rollouts) -> States:
        """The same without dynamics."""
        q, qd = torch.from_numpy(self._going_on(rollouts))
        return q, qd

    def _going_on(self, rollouts: Rollouts) -> np.ndarray:
        return rollouts.still + self.extrapolation.added(rollouts.qd, rollouts.change, rollouts.times)


def good_for(model: Any, calibration: CalibrationWindows) -> float | None:
    """The longest time [s] ahead up to which a model's forecasts of training windows are clearly better than
    extrapolated motion; None: there is none.
    """
    motion = training_motion(calibration, model.joint_types)
    if motion is None:
        return None
    predictor = for_windows(of_dynamics(MODEL, model, 1), calibration.probe)
    return forecast_of(predictor, motion).trust.good_for


def for_windows(predictor: Predictor, probe: Windows) -> Predictor:
    """The same dynamics, in the steps that they need on such windows, whose samples may lie farther apart."""
    dynamics = predictor.dynamics
    if dynamics is None:
        return predictor
    if predictor.name != MODEL:
        return of_baseline(predictor.name, dynamics, probe)
    model: Any = dynamics
    return of_dynamics(MODEL, model, choose_substeps(model, probe, loss_scales(probe, model.joint_types)))


def past_steps(rate: float) -> int:
    """Steps at this rate [Hz] that the disturbance is estimated from."""
    return max(1, round(PAST * rate))


def rolled(predictor: Predictor, windows: Windows, past: int) -> Rollouts:
    """Rollouts of windows of `past` steps, a present sample and more."""
    with torch.no_grad(), np.errstate(over="ignore", invalid="ignore"):  # bad dynamics leave all bounds
        ahead, disturbance = after_past(predictor.form, windows, past)
        both = joined([ahead, ahead])  # one rollout of twice the windows takes about as long as one
        predicted = _safe(predictor, both, torch.cat([torch.zeros_like(disturbance), disturbance]))
    open_loop, held = np.split(torch.stack(predicted).numpy(), 2, axis=1)
    return Rollouts(ahead, _still(ahead), open_loop, held, *_velocities(windows, past))


def _safe(predictor: Predictor, windows: Windows, disturbance: torch.Tensor) -> States:
    """Predictions; where numbers blow up they are NaN, for few windows beside those that are to blame."""
    try:
        q, qd = predictor.states(windows, disturbance)
    except torch.linalg.LinAlgError:
        rows = torch.arange(len(windows)).tensor_split(PARTS)
        parts = [_whole_or_none(predictor, windows, disturbance, each) for each in rows if len(each)]
        q, qd = (torch.cat(x) for x in zip(*parts, strict=True))
    return q, qd


def _whole_or_none(
    predictor: Predictor, windows: Windows, disturbance: torch.Tensor, rows: torch.Tensor
) -> States:
    part = windows[rows]
    try:
        q, qd = predictor.states(part, disturbance[rows])
    except torch.linalg.LinAlgError:
        q = qd = torch.full_like(part.q[:, 1:], torch.nan)
    return q, qd


def training_motion(calibration: CalibrationWindows, joint_types: Sequence[str]) -> TrainingMotion | None:
    """How training windows went on; None: these are of too few stretches of time to tell."""
    if calibration.blocks.max() + 1 < LEAST_BLOCKS:
        return None
    windows, past = calibration.windows, calibration.past
    ahead, (qd, change) = without_past(windows, past), _velocities(windows, past)
    elapsed = _elapsed(ahead)
    wanted = [time for time in TIMES if time <= 1.02 * elapsed[-1]]
    chosen = np.unique([np.abs(elapsed - time).argmin() for time in wanted]) if wanted else np.array([0])
    steps = position_difference(ahead.q[:, 1:], ahead.q[:, :-1], joint_types)
    q = ahead.q[:, :1] + steps.cumsum(dim=1)  # as rollouts go: on past a turn
    still = _still(ahead)[:, :, chosen]
    measured = np.stack([q.numpy(), ahead.qd[:, 1:].numpy()])[:, :, chosen] - still
    times, seconds = elapsed[chosen], windows.dt[:, :past].sum(dim=1).mean().item()
    on = extrapolation(qd, change, measured, calibration.blocks, times, seconds)
    added = on.added(qd, change, times)
    return TrainingMotion(calibration, chosen, times, on, still + added, measured - added)


def forecast_of(predictor: Predictor, motion: TrainingMotion) -> Forecast:
    """The forecasts that training windows show to be worth it."""
    calibration = motion.calibration
    found = rolled(predictor, calibration.windows, calibration.past)
    open_loop, held = (x[:, :, motion.chosen] - motion.going_on for x in (found.open_loop, found.held))
    trust = calibrated(open_loop, held, motion.measured, calibration.blocks, motion.times)
    return Forecast(motion.extrapolation, trust)


def _still(ahead: Windows) -> np.ndarray:
    """q and qd at constant velocity, (2, W, K-1, n)."""
    return torch.stack(constant_velocity().states(ahead)).numpy()


def _elapsed(ahead: Windows) -> np.ndarray:
    """Times ahead, (K-1,) [s]."""
    elapsed: np.ndarray = ahead.dt.cumsum(dim=1).mean(dim=0).numpy()
    return elapsed


def _velocities(windows: Windows, past: int) -> tuple[np.ndarray, np.ndarray]:
    """qd at the present sample, and its change over the past, (W, n) both."""
    qd = windows.qd[:, past]
    return qd.numpy(), (qd - windows.qd[:, 0]).numpy()
