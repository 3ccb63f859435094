"""Predicted pieces of test trajectories beside what was measured, for people to look at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from spelgen.baselines.predictor import Predictor
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import cut_windows

MOST = 3


@dataclass(frozen=True)
class JointExample:
    """One joint over the samples of an example [rad, rad/s; m, m/s]; None: prediction not finite."""

    name: str
    q_true: tuple[float, ...]
    q_pred: tuple[float | None, ...]
    qd_true: tuple[float, ...]
    qd_pred: tuple[float | None, ...]


@dataclass(frozen=True)
class Example:
    """A piece of a trajectory, predicted from its first sample; t counts from there [s]."""

    trajectory: str
    t: tuple[float, ...]
    joints: tuple[JointExample, ...]


def predict_examples(
    predictor: Predictor,
    pieces: Sequence[Trajectory],
    steps: int,
    joints: Sequence[str],
    *,
    decimation: int = 1,
    measured: bool,
) -> tuple[Example, ...]:
    """Up to three examples of `steps` steps of `decimation` samples, each from the middle of another trajectory,
    evenly chosen.
    """
    long_enough = list({x.name: x for x in pieces if len(x.t) > steps * decimation}.values())
    chosen = long_enough[:: -(-len(long_enough) // MOST)]
    return tuple(_example(predictor, piece, steps, joints, decimation, measured) for piece in chosen)


def _example(
    predictor: Predictor,
    piece: Trajectory,
    steps: int,
    joints: Sequence[str],
    decimation: int,
    measured: bool,
) -> Example:
    start = (len(piece.t) - 1 - steps * decimation) // (2 * decimation) * decimation
    part = piece[start : start + steps * decimation + 1]
    window = cut_windows([part], steps + 1, decimation=decimation, measured=measured)
    part = part[::decimation]
    with torch.no_grad():
        predicted = predictor.solver(window)  # each (1, steps, n)
    q, qd = (
        torch.cat([first[:, :1], rest], dim=1)[0]
        for first, rest in zip((window.q, window.qd), predicted, strict=True)
    )
    columns = zip(joints, part.q.T, q.T, part.qd.T, qd.T, strict=True)
    return Example(
        piece.name,
        tuple((part.t - part.t[0]).tolist()),
        tuple(
            JointExample(
                name, tuple(q_true.tolist()), _finite(q_pred), tuple(qd_true.tolist()), _finite(qd_pred)
            )
            for name, q_true, q_pred, qd_true, qd_pred in columns
        ),
    )


def _finite(values: torch.Tensor) -> tuple[float | None, ...]:
    return tuple(x if math.isfinite(x) else None for x in values.tolist())
