"""The curves behind the figures of an evaluation: for pages, and for programs as `traces` of evaluation.json.

Everything is plain lists and numbers [rad, m, s, Nm, N, kg m^2, J], rounded to five digits; None where not finite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from spelgen.baselines.names import MODEL
from spelgen.baselines.predictor import Predictor
from spelgen.dynamics.bristles import BristleReach
from spelgen.dynamics.protocol import RigidDynamics
from spelgen.evaluation.horizons import Predictions
from spelgen.evaluation.replay import Missed
from spelgen.evaluation.torque_traces import plain, torque_trace
from spelgen.fitting.rollout import loss_scales, position_difference
from spelgen.logs.coverage import coverage
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows

TIMES = 24  # at which it is told
QUANTILES = (0.1, 0.5, 0.9)
SHOWN = 240  # samples of a predicted trajectory
SHOWN_OF_LOG = 600  # of a whole log


def traces(
    predictors: Sequence[Predictor],
    pieces: Sequence[Trajectory],
    predicted: Predictions | None,
    joint_types: Sequence[str],
    *,
    used: Preprocessing,
    reach: BristleReach,
    tip: Any = None,
) -> dict[str, Any]:
    """All curves. pieces: gap-free and filtered. predicted: of the longest horizon. tip: its position [m] by q.

    reach: of the bristles that friction remembers with.
    """
    dynamics = {x.name: x.dynamics for x in predictors if x.dynamics is not None}
    found: dict[str, Any] = {"coverage": coverage(pieces)}
    if predicted is not None:
        found |= _predictions(predicted, joint_types, tip)
    model = next((x for x in predictors if x.name == MODEL and x.dynamics is not None), None)
    if model is not None and model.dynamics is not None:
        found["torques"] = torque_trace(model.dynamics, dynamics, pieces, used, reach)
        found["mass"] = _masses(dynamics, found)
        found["friction"] = _friction(dynamics, pieces, found["torques"])
    return found


def replay_traces(missed: Sequence[Missed]) -> dict[str, Any]:
    """Of an arm under position servos: the logs of the middle and the largest error, positions measured, commanded
    and predicted.
    """
    size = [float(np.sqrt(np.square(x).mean())) for _, x in missed]
    order = np.argsort(size, kind="stable")
    examples = []
    for which, k in (("typical", order[len(order) // 2]), ("worst", order[-1])):
        log, error = missed[k]
        predicted = np.concatenate([log.q[:1], log.q[1:] + error])
        columns = {"t": log.t - log.t[0], "q": log.q, "u": log.u, "predicted_q": predicted}
        stride = -(-len(log) // SHOWN_OF_LOG)
        told = {"which": which, "trajectory": log.name, "error": plain(size[k])}
        examples.append(told | {name: plain(x[::stride]) for name, x in columns.items()})
    return {"coverage": coverage([x for x, _ in missed]), "trajectories": examples}


def _predictions(found: Predictions, joint_types: Sequence[str], tip: Any) -> dict[str, Any]:
    """How errors grow with the horizon, and the predictions of the middle and the largest error."""
    windows = found.windows
    steps = windows.dt.shape[1]
    times = np.unique(np.geomspace(1, steps, TIMES).round().astype(int)) - 1
    scales = loss_scales(windows, joint_types)
    grown: dict[str, Any] = {}
    tips: dict[str, Any] = {}
    examples: list[dict[str, Any]] = []
    for name, (q, qd) in found.states.items():
        away = position_difference(q, windows.q[:, 1:], joint_types)
        error = torch.cat([away / scales.q, (qd - windows.qd[:, 1:]) / scales.qd], dim=-1)
        size = error.square().mean(dim=-1).sqrt()  # (W, steps)
        grown[name] = _quantiles(size[:, times])
        if tip is not None:
            distance = 1000 * (tip(q[:, times]) - tip(windows.q[:, 1:][:, times])).norm(dim=-1)
            tips[name] = _quantiles(distance)
        if name == MODEL:
            order = size[:, -1].nan_to_num(nan=torch.inf).argsort()
            chosen = {"typical": int(order[len(order) // 2]), "worst": int(order[-1])}
            examples = [
                _example(which, found.starts[k], windows[k : k + 1], q[k], qd[k], size[k, -1].item())
                for which, k in chosen.items()
            ]
    seconds = windows.dt.cumsum(dim=1).mean(dim=0)[times]
    return {
        "growth": {"seconds": plain(seconds), "windows": len(windows), "relative": grown, "tip_mm": tips},
        "trajectories": examples,
    }


def _quantiles(values: torch.Tensor) -> dict[str, Any]:
    """Over windows (W, times): not finite counts as infinite."""
    ordered = values.nan_to_num(nan=torch.inf).sort(dim=0).values
    rows = [ordered[round(part * (len(ordered) - 1))] for part in QUANTILES]
    return dict(zip(("low", "median", "high"), map(plain, rows), strict=True))


def _example(
    which: str,
    start: tuple[Trajectory, int],
    window: Windows,
    q: torch.Tensor,
    qd: torch.Tensor,
    error: float,
) -> dict[str, Any]:
    piece, first = start
    stride = -(-len(q) // SHOWN)
    t = torch.cat([window.dt.new_zeros(1), window.dt[0].cumsum(dim=0)])
    predicted = (torch.cat([x[0, :1], y]) for x, y in ((window.q, q), (window.qd, qd)))
    columns = dict(
        zip(
            ("t", "q", "qd", "predicted_q", "predicted_qd"),
            (t, window.q[0], window.qd[0], *predicted),
            strict=True,
        )
    )
    told = {name: plain(x[::stride]) for name, x in columns.items()}
    return {
        "which": which,
        "trajectory": piece.name,
        "start": plain(piece.t[first] - piece.t[0]),
        "error": plain(error),
    } | told


def _masses(dynamics: Mapping[str, RigidDynamics], found: Mapping[str, Any]) -> dict[str, Any]:
    """M along the first trajectory that is drawn: its lower triangle, row by row, and its eigenvalues."""
    along = [*found["torques"], *found.get("trajectories", [])]
    if not along:
        return {}
    stride = -(-len(along[0]["t"]) // SHOWN)
    q = torch.tensor(along[0]["q"], dtype=torch.float64)[::stride]
    shown: dict[str, Any] = {}
    for name, each in dynamics.items():
        with torch.no_grad():
            mass = torch.as_tensor(each.mass_matrix(q))
        if mass.isfinite().all():
            rows, columns = torch.tril_indices(mass.shape[-1], mass.shape[-1])
            shown[name] = {
                "entries": plain(mass[:, rows, columns].mT),
                "eigenvalues": plain(torch.linalg.eigvalsh(mass).mT),
            }
    return {"trajectory": along[0]["trajectory"], "t": along[0]["t"][::stride], "by": shown}


def _friction(
    dynamics: Mapping[str, RigidDynamics], pieces: Sequence[Trajectory], torques: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Friction by velocity, each joint alone at the mean position; and what the rigid bodies leave of the torque."""
    q = np.concatenate([piece.q for piece in pieces])
    fast = np.quantile(np.abs(np.concatenate([piece.qd for piece in pieces])), 0.995, axis=0)
    middle = torch.from_numpy(q.mean(axis=0))
    n = len(middle)
    grid = np.sinh(np.linspace(-4, 4, 81)) / np.sinh(4)  # dense where friction turns around
    speeds = torch.from_numpy(grid[:, None] * fast)  # (81, n)
    curves: dict[str, Any] = {}
    for name, each in dynamics.items():
        with torch.no_grad():
            moved = torch.diag_embed(speeds)  # one joint at a time
            torque = each.friction_torque(middle.expand(len(speeds), n, n), moved)
        curves[name] = plain(torch.diagonal(torch.as_tensor(torque), dim1=-2, dim2=-1).mT)
    left = [
        {
            "qd": [row[k] for trace in torques for row in trace["qd"]],
            "torque": [
                None if a is None or b is None else a - b
                for trace in torques
                for a, b in zip(
                    (row[k] for row in trace["measured"]),
                    (row[k] for row in trace["without_friction"]),
                    strict=True,
                )
            ],
        }
        for k in range(n)
    ]
    return {"qd": plain(speeds.mT), "by": curves, "measured": left}
