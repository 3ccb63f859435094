"""What an evaluation finds, in the form that evaluation.json has, and how errors come into it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from spelgen.errors import Diagnostic
from spelgen.evaluation.baselines import Contender
from spelgen.evaluation.examples import Example
from spelgen.evaluation.torque import TorqueErrors
from spelgen.fitting.rollout import position_difference
from spelgen.logs.windows import Windows

Tip = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Errors:
    """Errors at the end of a horizon, root mean square over windows, per joint where a tuple.

    q, qd: [rad, rad/s; m, m/s], revolute positions as angles on the circle. q_share, qd_share: the same
    relative to how much q and qd change over the horizon. mean_share: mean of all q_share and qd_share.
    tip_mm: distance of the tip [mm]. None: not finite, or not known.
    """

    q: tuple[float | None, ...]
    qd: tuple[float | None, ...]
    q_share: tuple[float | None, ...]
    qd_share: tuple[float | None, ...]
    mean_share: float | None
    tip_mm: float | None


@dataclass(frozen=True)
class Horizon:
    """How far ahead: a number of samples, in the mean `seconds`; from `windows` starting points."""

    name: str
    steps: int
    seconds: float
    windows: int
    errors: dict[str, Errors]


@dataclass(frozen=True)
class Torque:
    """Errors of the inverse dynamics of one contender by the protocol of `torque_samples`.

    nmse: per trajectory, mean over joints. mean_nmse: mean over trajectories. rmse: per joint [Nm, N], mean
    over trajectories.
    """

    nmse: dict[str, float | None]
    mean_nmse: float | None
    rmse: tuple[float | None, ...]


@dataclass(frozen=True)
class Evaluation:
    """What `evaluate` found; `to_dict` is evaluation.json.

    cutoff: of the filter on the test logs [Hz], None without. torque: by contender, empty where the logs are
    too sparse. energy_drift: of the model without input and dissipation over 1 s, integrated to thirteen digits,
    relative to its kinetic energy; None where the logs never move. examples: over the longest horizon.
    """

    robot: str
    joints: tuple[str, ...]
    trajectories: tuple[str, ...]
    cutoff: float | None
    substeps: int
    parameters: int
    horizons: tuple[Horizon, ...]
    torque: dict[str, Torque]
    energy_drift: float | None
    examples: tuple[Example, ...]
    diagnostics: tuple[Diagnostic, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON form, versioned by `schema`."""
        return {"schema": 1} | asdict(self)


def state_errors(
    contender: Contender, windows: Windows, joint_types: Sequence[str], tip: Tip | None
) -> Errors:
    with torch.no_grad():
        q, qd = (x[:, -1] for x in contender.roll_out(windows))  # (W, n)
        measured_q, measured_qd = windows.q[:, -1], windows.qd[:, -1]
        error = position_difference(q, measured_q, joint_types), qd - measured_qd
        change = position_difference(measured_q, windows.q[:, 0], joint_types), measured_qd - windows.qd[:, 0]
        shares = [_rms(e) / _rms(c) for e, c in zip(error, change, strict=True)]
        away = (
            None if tip is None else 1000 * _rms((tip(q) - tip(measured_q)).norm(dim=-1, keepdim=True)).item()
        )
    return Errors(
        q=_finite(_rms(error[0])),
        qd=_finite(_rms(error[1])),
        q_share=_finite(shares[0]),
        qd_share=_finite(shares[1]),
        mean_share=_finite(torch.cat(shares).mean().unsqueeze(0))[0],
        tip_mm=away if away is not None and math.isfinite(away) else None,
    )


def _rms(values: torch.Tensor) -> torch.Tensor:
    """(W, n) -> (n,)."""
    return values.square().mean(dim=0).sqrt()


def _finite(values: torch.Tensor) -> tuple[float | None, ...]:
    """Floats for JSON, which has no NaN."""
    return tuple(x if math.isfinite(x) else None for x in values.tolist())


def torque_figures(errors: TorqueErrors) -> Torque:
    nmse = torch.from_numpy(errors.nmse)
    by_trajectory = nmse.nanmean(dim=1)
    return Torque(
        nmse=dict(zip(errors.trajectories, _finite(by_trajectory), strict=True)),
        mean_nmse=_finite(by_trajectory.mean().unsqueeze(0))[0],
        rmse=_finite(torch.from_numpy(errors.rmse).mean(dim=0)),
    )
