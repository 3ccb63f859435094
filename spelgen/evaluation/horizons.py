"""Predictions of test logs some samples or seconds ahead, by all predictors from the same starting points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from spelgen.baselines.names import MODEL, observed
from spelgen.baselines.predictor import Predictor, of_accurate_dynamics, of_dynamics
from spelgen.baselines.solver import Solver, States
from spelgen.dynamics.bristles import BristleReach
from spelgen.errors import Diagnostic
from spelgen.evaluation.momentum_observer import observe, past_steps, without_past
from spelgen.evaluation.results import Horizon, end_errors
from spelgen.fitting.rollout import choose_substeps, loss_scales
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


def predict(
    name: str,
    steps: int,
    logs: JudgedLogs,
    predictors: Sequence[Predictor],
    joint_types: Sequence[str],
    tip: Callable[[torch.Tensor], torch.Tensor] | None,
    probed: int,
    notes: list[Diagnostic],
) -> tuple[Horizon, Predictions]:
    """Judge rollouts over so many samples: open loop, and with what a momentum observer finds before they start.

    tip: its position [m] by q. probed: samples of the windows that say how many steps integrators need.
    """
    decimation = _decimation(steps, logs.rate)
    if decimation > 1:
        probe = logs.windows(probed, PROBED, decimation)
        predictors = [_in_steps_for(x, probe, joint_types) for x in predictors]
    most, past = max(min(MOST_WINDOWS, PREDICTED_STEPS // steps), 1), past_steps(logs.rate / decimation)
    if past * decimation + steps > logs.longest:
        message = f"no observer over {name}: the longest trajectory has {logs.longest} steps"
        notes.append(Diagnostic("info", "no-observer", "logs", None, message))
        past = 0
    samples = past + steps // decimation + 1
    windows = logs.windows(samples, most, decimation)
    ahead = without_past(windows, past)
    states = {}
    for predictor in predictors:
        if not past or not isinstance(predictor.solver, Solver):
            states[predictor.name] = predictor.solver(ahead)
            continue
        with torch.no_grad():
            started, disturbance = observe(predictor.solver.form, windows, past)
        states[predictor.name] = predictor.solver(started)
        states[observed(predictor.name)] = predictor.solver(started, disturbance)
    errors = {name: end_errors(state, ahead, joint_types, tip) for name, state in states.items()}
    seconds = ahead.dt.sum(dim=1).mean().item()
    starts = [(piece, k + past * decimation) for piece, k in logs.starts(samples, most, decimation)[0]]
    return Horizon(name, steps, seconds, len(ahead), errors), Predictions(ahead, starts, states)


def _in_steps_for(predictor: Predictor, probe: Windows, joint_types: Sequence[str]) -> Predictor:
    """Return the same dynamics, in the steps that they need on windows whose samples lie farther apart."""
    dynamics = predictor.dynamics
    if dynamics is None:
        return predictor
    if predictor.name != MODEL:
        return of_accurate_dynamics(predictor.name, dynamics, probe)
    model: Any = dynamics
    return of_dynamics(MODEL, model, choose_substeps(model, probe, loss_scales(probe, joint_types)))


def _decimation(steps: int, rate: float) -> int:
    """The largest whole part of the steps that leaves enough of them, and samples dense enough."""
    largest = max(1, min(int(rate / DENSEST), steps // LEAST_STEPS))
    return max(k for k in range(1, largest + 1) if steps % k == 0)
