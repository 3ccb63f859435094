"""Predictions of test logs some samples or seconds ahead, by all predictors from the same starting points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from spelgen.dynamics.bristles import BristleReach
from spelgen.errors import Diagnostic
from spelgen.evaluation.baselines import Predictor
from spelgen.evaluation.disturbance import without_past
from spelgen.evaluation.forecast import Forecast, for_windows, past_steps, rolled
from spelgen.evaluation.names import EXTRAPOLATION
from spelgen.evaluation.results import Horizon, end_errors
from spelgen.evaluation.stiff import States
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows

PREDICTED_STEPS = 40_000  # per horizon and predictor: windows are thinned evenly to about this many
MOST_WINDOWS = 2000
PROBED = 64  # windows that say how many steps the integrator needs
DENSEST = 200.0  # [Hz] inputs of denser logs are averaged where a horizon
LEAST_STEPS = 100  # has still as many steps then


@dataclass(frozen=True, eq=False)
class JudgedLogs:
    """Pieces of test logs, gap-free and filtered, of which windows are cut. reach: of what friction remembers with."""

    pieces: Sequence[Trajectory]
    used: Preprocessing
    reach: BristleReach

    @property
    def rate(self) -> float:
        """Samples a second [Hz]."""
        return sum(x.sample_rate for x in self.pieces) / len(self.pieces)

    @property
    def longest(self) -> int:
        """Steps of the longest piece."""
        return max(map(len, self.pieces)) - 1

    def starts(
        self, samples: int, most: int, decimation: int = 1
    ) -> tuple[list[tuple[Trajectory, int]], int]:
        """Where about `most` windows begin, or all, evenly spread; and how many samples lie between them."""
        span = (samples - 1) * decimation
        stride = -(-sum(max(0, len(x) - span) for x in self.pieces) // most)
        return [(x, k) for x in self.pieces for k in range(0, len(x) - span, stride)], stride

    def windows(self, samples: int, most: int, decimation: int = 1) -> Windows:
        """The windows of so many samples that begin there, shorter ones where all pieces are."""
        samples = min(samples, self.longest // decimation + 1)
        stride = self.starts(samples, most, decimation)[1]
        return cut_windows(
            self.pieces, samples, stride, decimation, measured=self.used.filtered, reach=self.reach
        )


@dataclass(frozen=True, eq=False)
class Predictions:
    """What was predicted of these windows, q and qd (W, K-1, n), by predictor. starts: the first sample of each."""

    windows: Windows
    starts: list[tuple[Trajectory, int]]
    states: dict[str, States]


def horizon_lengths(
    logs: JudgedLogs, steps: Sequence[int], seconds: Sequence[float], notes: list[Diagnostic]
) -> dict[str, int]:
    """Horizon name -> number of samples ahead; those longer than every trajectory are left out, and said."""
    wanted = {f"{k} step{'s' if k > 1 else ''}": k for k in steps}
    wanted |= {f"{duration:g} s": round(duration * logs.rate) for duration in seconds}
    for name, k in wanted.items():
        if not 0 < k <= logs.longest:
            message = f"no prediction over {name}: the longest trajectory has {logs.longest} steps"
            notes.append(Diagnostic("info", "horizon-too-long", "logs", None, message))
    return {name: k for name, k in wanted.items() if 0 < k <= logs.longest}


def open_loop_note(message: str) -> Diagnostic:
    """That forecasts are not to be had."""
    return Diagnostic("info", "open-loop", "logs", None, message)


def predict(
    name: str,
    steps: int,
    logs: JudgedLogs,
    predictors: Sequence[Predictor],
    forecasts: Mapping[str, Forecast],
    joint_types: Sequence[str],
    tip: Callable[[torch.Tensor], torch.Tensor] | None,
    probed: int,
    notes: list[Diagnostic],
) -> tuple[Horizon, Predictions]:
    """Errors over so many samples, of forecasts where these reach that far and pieces are long enough for a past.

    tip: its position [m] by q. probed: samples of the windows that say how many steps integrators need.
    """
    decimation = _decimation(steps, logs.rate)
    if decimation > 1:
        probe = logs.windows(probed, PROBED, decimation)
        predictors = [for_windows(x, probe) for x in predictors]
    most, past = max(min(MOST_WINDOWS, PREDICTED_STEPS // steps), 1), past_steps(logs.rate / decimation)
    reached = all(x.trust.reaches(steps / logs.rate) for x in forecasts.values())
    if not forecasts or not reached or past * decimation + steps >= logs.longest + 1:
        past = 0
    if forecasts and not past:
        reason = "these trajectories have no past" if reached else "windows of its training logs are shorter"
        notes.append(open_loop_note(f"no forecasts over {name}, rollouts are open loop: {reason}"))
    samples = past + steps // decimation + 1
    windows = logs.windows(samples, most, decimation)
    ahead = without_past(windows, past)
    states, open_loop = {}, {}
    for predictor in predictors:
        forecast = forecasts.get(predictor.name)
        if past and forecast is not None:
            found = rolled(predictor, windows, past)
            q, qd = torch.from_numpy(found.open_loop)
            states[predictor.name], open_loop[predictor.name] = forecast.states(found), (q, qd)
            if EXTRAPOLATION not in states:  # the same beside all
                states[EXTRAPOLATION] = forecast.going_on(found)
        else:
            with torch.no_grad():
                states[predictor.name] = predictor.states(ahead)
            if past:
                open_loop[predictor.name] = states[predictor.name]
    errors, alone = (
        {name: end_errors(each, ahead, joint_types, tip) for name, each in found.items()}
        for found in (states, open_loop)
    )
    seconds = ahead.dt.sum(dim=1).mean().item()
    starts = [(piece, k + past * decimation) for piece, k in logs.starts(samples, most, decimation)[0]]
    return Horizon(name, steps, seconds, len(ahead), errors, alone), Predictions(ahead, starts, states)


def _decimation(steps: int, rate: float) -> int:
    """The largest whole part of the steps that leaves enough of them, and samples dense enough."""
    largest = max(1, min(int(rate / DENSEST), steps // LEAST_STEPS))
    return max(k for k in range(1, largest + 1) if steps % k == 0)
