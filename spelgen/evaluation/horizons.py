"""Predictions of test logs some samples or seconds ahead, by all predictors from the same starting points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import torch

from spelgen.baselines.names import MODEL, observed
from spelgen.baselines.predictor import Predictor, of_accurate_dynamics, of_dynamics
from spelgen.baselines.solver import Solver, States
from spelgen.dynamics.bristles import BristleReach
from spelgen.errors import Diagnostic
from spelgen.evaluation.momentum_observer import observe, past_steps, without_past
from spelgen.evaluation.state_errors import StateErrors, TipPosition, end_errors
from spelgen.fitting.rollout import choose_substeps, loss_scales
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.tuning.evaluation import EvaluationTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = EvaluationTuning()


@dataclass(frozen=True)
class Horizon:
    """How far ahead: a number of samples, in the mean `seconds`; from `windows` starting points.

    errors: by predictor, open loop, and as `observed(predictor)` where it holds what a momentum observer finds.
    """

    name: str
    steps: int
    seconds: float
    windows: int
    errors: dict[str, StateErrors]


@dataclass(frozen=True, eq=False)
class JudgedLogs:
    """Pieces of test logs, gap-free and filtered, of which windows are cut. reach: of the bristles of friction."""

    pieces: Sequence[Trajectory]
    used: Preprocessing
    reach: BristleReach
    joint_types: Sequence[str]

    @property
    def rate(self) -> float:
        """Samples a second [Hz]."""
        return sum(x.sample_rate for x in self.pieces) / len(self.pieces)

    @property
    def longest(self) -> int:
        """Steps of the longest piece."""
        return max(map(len, self.pieces)) - 1

    def stride(self, span: int, most: int) -> int:
        """Return how many samples lie between the starts of about `most` windows of so many steps."""
        return -(-sum(max(0, len(piece) - span) for piece in self.pieces) // most)

    def starts(self, span: int, most: int) -> list[tuple[Trajectory, int]]:
        """Return the pieces and first samples of these windows."""
        stride = self.stride(span, most)
        starts: list[tuple[Trajectory, int]] = []
        for piece in self.pieces:
            starts += [(piece, first) for first in range(0, len(piece) - span, stride)]
        return starts

    def windows(self, samples: int, most: int, decimation: int = 1) -> Windows:
        """Return the windows of so many samples that begin there, shorter ones where all pieces are."""
        samples = min(samples, self.longest // decimation + 1)
        stride = self.stride((samples - 1) * decimation, most)
        measured = self.used.filtered
        return cut_windows(self.pieces, samples, stride, decimation, measured=measured, reach=self.reach)

    def probe(self, samples: int, decimation: int = 1) -> Windows:
        """Return few windows, that say how many steps integrators need."""
        return self.windows(samples, TUNING.probed_model_windows, decimation)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predicted q and qd (W, K-1, n) of windows by predictor. starts: the piece and first sample of each."""

    windows: Windows
    starts: list[tuple[Trajectory, int]]
    states: dict[str, States]


def horizon_lengths(
    logs: JudgedLogs, steps: Sequence[int], seconds: Sequence[float], notes: list[Diagnostic]
) -> dict[str, int]:
    """Return the number of samples of each horizon by name; those longer than every trajectory are left out, and
    noted.
    """
    lengths = {}
    for k in steps:
        lengths["1 step" if k == 1 else f"{k} steps"] = k
    for duration in seconds:
        lengths[f"{duration:g} s"] = round(duration * logs.rate)
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
    logs: JudgedLogs,
    predictors: Sequence[Predictor],
    tip: TipPosition | None,
    probed: int,
    notes: list[Diagnostic],
) -> tuple[Horizon, Predictions]:
    """Judge rollouts over so many samples: open loop, and with what a momentum observer finds before they start.

    probed: samples of the windows that say how many steps integrators need.
    """
    decimation = _decimation(steps, logs.rate)
    if decimation > 1:
        probe = logs.probe(probed, decimation)
        predictors = [_in_steps_for(predictor, probe, logs.joint_types) for predictor in predictors]
    past = past_steps(logs.rate / decimation)
    if past * decimation + steps > logs.longest:
        message = f"no observer over {name}: the longest trajectory has {logs.longest} steps"
        notes.append(Diagnostic("info", "no-observer", "logs", None, message))
        past = 0
    most = max(1, min(TUNING.most_windows, TUNING.most_predicted_steps // steps))
    span = past * decimation + steps
    windows = logs.windows(span // decimation + 1, most, decimation)
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
    errors = {who: end_errors(state, ahead, logs.joint_types, tip) for who, state in states.items()}
    seconds = ahead.dt.sum(dim=1).mean().item()
    starts = [(piece, first + past * decimation) for piece, first in logs.starts(span, most)]
    return Horizon(name, steps, seconds, len(ahead), errors), Predictions(ahead, starts, states)


def _in_steps_for(predictor: Predictor, probe: Windows, joint_types: Sequence[str]) -> Predictor:
    """Return the same dynamics, in the steps that they need on windows whose samples lie farther apart."""
    dynamics = predictor.dynamics
    if dynamics is None:
        return predictor
    if predictor.name != MODEL:
        return of_accurate_dynamics(predictor.name, dynamics, probe)
    model = cast("EmittedModel", dynamics)
    return of_dynamics(MODEL, dynamics, choose_substeps(model, probe, loss_scales(probe, joint_types)))


def _decimation(steps: int, rate: float) -> int:
    """Return the largest divisor of the steps that leaves enough of them, and samples dense enough.

    Inputs of the samples between are averaged.
    """
    largest = max(1, min(int(rate / TUNING.densest_rate), steps // TUNING.fewest_steps))
    return max(k for k in range(1, largest + 1) if steps % k == 0)
