"""What an evaluation finds: for people, notebooks, and as evaluation.json."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from html import escape
from typing import Any

import torch

from spelgen.baselines.names import MODEL
from spelgen.baselines.solver import States
from spelgen.errors import Diagnostic
from spelgen.evaluation.replay import Replay
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.torque import TorqueErrors
from spelgen.evaluation.verdict import verdict
from spelgen.fitting.rollout import position_difference
from spelgen.logs.windows import Windows

SCHEMA = 6


@dataclass(frozen=True)
class StateErrors:
    """Errors at the end of a horizon, root mean square (RMS) over windows, per joint where a tuple.

    q, qd: [rad, rad/s; m, m/s], revolute positions as angles on the circle. q_relative_rms, qd_relative_rms:
    relative to how much q and qd change over the horizon. mean_relative_rms: mean of all of these. tip_mm: distance
    of the tip [mm]. None: not finite, or not known.
    """

    q: tuple[float | None, ...]
    qd: tuple[float | None, ...]
    q_relative_rms: tuple[float | None, ...]
    qd_relative_rms: tuple[float | None, ...]
    mean_relative_rms: float | None
    tip_mm: float | None


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


@dataclass(frozen=True)
class TorqueSummary:
    """Errors of the inverse dynamics of one predictor by the protocol of `dynamics_samples`.

    nmse: per trajectory, mean over joints. mean_nmse: mean over trajectories. rmse: per joint [Nm, N], mean
    over trajectories.
    """

    nmse: dict[str, float | None]
    mean_nmse: float | None
    rmse: tuple[float | None, ...]


@dataclass(frozen=True, repr=False)
class Results:
    """What `evaluate` found; `to_dict` is evaluation.json.

    cutoff: of the filter on the test logs [Hz], None without. substeps: of rk4 between samples. parameters: trained
    numbers of the model. torque: by predictor, empty where the logs are too sparse. energy_drift: of the model
    without input and dissipation over 1 s, integrated to thirteen digits, relative to its kinetic energy; None where
    the logs never move. traces: the curves behind the figures;
    those of predictions are the longest horizon's, see `traces.py`. replays: of commands, of an arm under
    position servos.
    """

    robot: str
    joints: tuple[str, ...]
    trajectories: tuple[str, ...]
    cutoff: float | None
    substeps: int
    parameters: int
    horizons: tuple[Horizon, ...]
    torque: dict[str, TorqueSummary]
    energy_drift: float | None
    diagnostics: tuple[Diagnostic, ...]
    traces: dict[str, Any] = field(default_factory=dict)
    joint_types: tuple[str, ...] = ()
    replays: tuple[Replay, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON form, versioned by `schema`."""
        found = {"schema": SCHEMA} | asdict(self)
        return found if self.replays else {name: x for name, x in found.items() if name != "replays"}

    def text(self) -> str:
        """For a terminal: every table, the best of each row starred."""
        tables = (table.text() for table in result_tables(self.to_dict()))
        return "\n\n".join([f"{self._heading()}; * marks the best of a row", *tables])

    def __repr__(self) -> str:
        last = self.horizons[-1] if self.horizons else None
        error = last and last.errors[MODEL].mean_relative_rms
        shown = f", relative RMS {error:.3g} after {last.name}" if last and error is not None else ""
        return f"<Results of {self._heading()}{shown}>"

    def _repr_html_(self) -> str:
        tables = (table.listing().html() for table in result_tables(self.to_dict()))
        return "".join([f"<p>{escape(verdict(self.to_dict()).sentence)}</p>", *tables])

    def _heading(self) -> str:
        count = len(self.trajectories)
        return f"{self.robot} on {count} test trajector{'ies' if count != 1 else 'y'}"


def end_errors(
    predicted: States,
    windows: Windows,
    joint_types: Sequence[str],
    tip: Callable[[torch.Tensor], torch.Tensor] | None,
) -> StateErrors:
    """Errors of what was predicted of these windows, q and qd (W, K-1, n), at their ends."""
    q, qd = (x[:, -1] for x in predicted)  # (W, n)
    measured_q, measured_qd = windows.q[:, -1], windows.qd[:, -1]
    error = position_difference(q, measured_q, joint_types), qd - measured_qd
    change = position_difference(measured_q, windows.q[:, 0], joint_types), measured_qd - windows.qd[:, 0]
    relative = [_rms(e) / _rms(c) for e, c in zip(error, change, strict=True)]
    away = math.nan
    if tip is not None:
        away = 1000 * _rms((tip(q) - tip(measured_q)).norm(dim=-1, keepdim=True)).item()
    return StateErrors(
        q=_finite(_rms(error[0])),
        qd=_finite(_rms(error[1])),
        q_relative_rms=_finite(relative[0]),
        qd_relative_rms=_finite(relative[1]),
        mean_relative_rms=_finite(torch.cat(relative).mean().unsqueeze(0))[0],
        tip_mm=away if math.isfinite(away) else None,
    )


def _rms(values: torch.Tensor) -> torch.Tensor:
    """(W, n) -> (n,)."""
    return values.square().mean(dim=0).sqrt()


def _finite(values: torch.Tensor) -> tuple[float | None, ...]:
    """Floats for JSON, which has no NaN."""
    return tuple(x if math.isfinite(x) else None for x in values.tolist())


def torque_summary(errors: TorqueErrors) -> TorqueSummary:
    """Means over joints and trajectories."""
    nmse = torch.from_numpy(errors.nmse)
    by_trajectory = nmse.nanmean(dim=1)
    return TorqueSummary(
        nmse=dict(zip(errors.trajectories, _finite(by_trajectory), strict=True)),
        mean_nmse=_finite(by_trajectory.mean().unsqueeze(0))[0],
        rmse=_finite(torch.from_numpy(errors.rmse).mean(dim=0)),
    )
