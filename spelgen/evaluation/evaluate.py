"""Judge a trained run on test logs, beside its rivals, on the same windows and with the same integrator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torchdiffeq import odeint

from spelgen.data.doubts import examine
from spelgen.data.logs import Trajectory, read_logs
from spelgen.data.signals import prepare
from spelgen.data.trajectory import rate
from spelgen.data.windows import Windows, cut_windows
from spelgen.errors import Diagnostic
from spelgen.evaluation.examples import Example, predict_examples
from spelgen.evaluation.tip import tip_position
from spelgen.evaluation.torque import TorqueErrors, torque_errors, torque_samples
from spelgen.log_mapping import LogMapping
from spelgen.spec import Header, read_header
from spelgen.training.data import filter_cutoff
from spelgen.training.rivals import Contender, held_velocity, trained, urdf_values
from spelgen.training.rollout import choose_substeps, loss_scales, position_difference
from spelgen.training.runs import RunFolder, trained_model, write_json

if TYPE_CHECKING:
    from spelgen.training.runs import EmittedModel

Tip = Callable[[torch.Tensor], torch.Tensor]

PREDICTED_STEPS = 40_000  # per horizon and contender: windows are thinned evenly to about this many
MOST_WINDOWS = 2000
DRIFT_SECONDS, DRIFT_TIMES = 1.0, 101
DRIFT_SOLVER: dict[str, Any] = {"rtol": 1e-13, "atol": 1e-15, "options": {"solver": "DOP853"}}
DRIFT_STATES, DRIFT_CALLS = 8, 30_000


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


def evaluate(
    folder: Path | str,
    data: Iterable[Path | str],
    *,
    steps: Sequence[int] = (1, 10),
    seconds: Sequence[float] = (1.0,),
    cutoff: float | None = None,
    mapping: LogMapping | None = None,
    threads: int = 1,
) -> Evaluation:
    """Evaluate the best model of a run on logs (a folder's test.* where there are such) and write
    evaluation.json.

    steps, seconds: horizons in samples and in time; those longer than every trajectory are left out, and
    said. cutoff: of the filter on the logs [Hz], 0: none; by default the one the run was trained with.
    mapping: how the logs are named and measured; by default as those that were trained on. The
    result depends on nothing else: no random numbers. Raises RunError, ModuleError, LogError.
    """
    torch.set_num_threads(threads)
    run = RunFolder(Path(folder))
    config = run.read_json(run.config)
    model, header = trained_model(run), read_header(run.module)
    mapping = mapping or LogMapping(**config.get("mapping", {}))
    trajectories = read_logs(data, header.joints, role="test", mapping=mapping, joint_types=model.joint_types)
    notes = examine(trajectories, header.joints, model.joint_types)
    notes += _seen(trajectories, config)
    used = config["cutoff"] if cutoff is None else filter_cutoff(cutoff, map(rate, trajectories))
    pieces = prepare(trajectories, shortest=2, cutoff=used)
    lengths = _lengths(pieces, steps, seconds, notes)
    probe = _windows(pieces, config["config"]["window"], 64, measured=used is not None)
    start = run.load_state(run.checkpoint)["substeps"]
    substeps = choose_substeps(model, probe, loss_scales(probe, model.joint_types), start=start)
    contenders = [trained(model, substeps), held_velocity(), *_urdf(run, header, substeps, notes)]
    tip = _tip(run, header, notes)
    samples = torque_samples(trajectories)
    result = Evaluation(
        robot=header.robot,
        joints=header.joints,
        trajectories=tuple(x.name for x in trajectories),
        cutoff=used,
        substeps=substeps,
        parameters=sum(parameter.numel() for parameter in model.parameters()),
        horizons=tuple(
            _horizon(name, k, pieces, contenders, model, tip, used) for name, k in lengths.items()
        ),
        torque={
            x.name: _torque(torque_errors(x.torque, samples)) for x in contenders if x.torque and samples
        },
        energy_drift=energy_drift(model, probe),
        examples=_examples(contenders[0], pieces, lengths, header.joints, used),
        diagnostics=tuple(notes),
    )
    write_json(run.evaluation, result.to_dict())
    return result


def _seen(trajectories: Sequence[Trajectory], config: dict[str, Any]) -> list[Diagnostic]:
    """A warning when a trajectory of this name was trained on."""
    known = set(config["training"]) | set(config["validation"])
    seen = [x.name for x in trajectories if x.name in known]
    if not seen:
        return []
    message = f"names also used in training: {', '.join(seen)}; errors on training data prove nothing"
    return [Diagnostic("warning", "tested-on-training-data", "logs", None, message)]


def _lengths(
    pieces: Sequence[Trajectory], steps: Sequence[int], seconds: Sequence[float], notes: list[Diagnostic]
) -> dict[str, int]:
    """Horizon name -> number of samples ahead."""
    frequency = sum(rate(x) for x in pieces) / len(pieces)
    wanted = {f"{k} step{'s' if k > 1 else ''}": k for k in steps}
    wanted |= {f"{duration:g} s": round(duration * frequency) for duration in seconds}
    longest = max(len(x.t) for x in pieces) - 1
    for name, k in wanted.items():
        if not 0 < k <= longest:
            message = f"no prediction over {name}: the longest trajectory has {longest} steps"
            notes.append(Diagnostic("info", "horizon-too-long", "logs", None, message))
    return {name: k for name, k in wanted.items() if 0 < k <= longest}


def _windows(pieces: Sequence[Trajectory], samples: int, most: int, *, measured: bool) -> Windows:
    """About `most` windows, or all, evenly spread."""
    samples = min(samples, max(len(x.t) for x in pieces))
    starts = sum(max(0, len(x.t) - samples + 1) for x in pieces)
    return cut_windows(pieces, samples, -(-starts // most), measured=measured)


def _horizon(
    name: str,
    steps: int,
    pieces: Sequence[Trajectory],
    contenders: Sequence[Contender],
    model: EmittedModel,
    tip: Tip | None,
    cutoff: float | None,
) -> Horizon:
    most = min(MOST_WINDOWS, PREDICTED_STEPS // steps)
    windows = _windows(pieces, steps + 1, max(most, 1), measured=cutoff is not None)
    errors = {x.name: _errors(x, windows, model.joint_types, tip) for x in contenders}
    return Horizon(name, steps, windows.dt.sum(dim=1).mean().item(), len(windows), errors)


def _examples(
    contender: Contender,
    pieces: Sequence[Trajectory],
    lengths: dict[str, int],
    joints: Sequence[str],
    cutoff: float | None,
) -> tuple[Example, ...]:
    if not lengths:
        return ()
    return predict_examples(contender, pieces, max(lengths.values()), joints, measured=cutoff is not None)


def _errors(contender: Contender, windows: Windows, joint_types: Sequence[str], tip: Tip | None) -> Errors:
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


def _torque(errors: TorqueErrors) -> Torque:
    nmse = torch.from_numpy(errors.nmse)
    by_trajectory = nmse.nanmean(dim=1)
    return Torque(
        nmse=dict(zip(errors.trajectories, _finite(by_trajectory), strict=True)),
        mean_nmse=_finite(by_trajectory.mean().unsqueeze(0))[0],
        rmse=_finite(torch.from_numpy(errors.rmse).mean(dim=0)),
    )


def _urdf(run: RunFolder, header: Header, substeps: int, notes: list[Diagnostic]) -> list[Contender]:
    """The URDF's own values as a rival, where they can be had."""
    if not run.urdf.exists():
        reason = "the run has no robot.urdf"
    else:
        try:
            return [urdf_values(run.urdf, header.joints, substeps)]
        except (
            Exception
        ) as error:  # Pinocchio and its parser raise many kinds; the evaluation stands without it
            reason = " ".join(f"{type(error).__name__}: {error}".split())
    notes.append(
        Diagnostic("info", "no-urdf-rival", "robot.urdf", None, f"no comparison with the URDF: {reason}")
    )
    return []


def _tip(run: RunFolder, header: Header, notes: list[Diagnostic]) -> Tip | None:
    if not run.urdf.exists():
        return None
    try:
        return tip_position(run.urdf, header.joints, header.options.tip)
    except Exception as error:  # as above, of pytorch-kinematics
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        notes.append(Diagnostic("info", "no-tip", "robot.urdf", None, f"no tip errors: {reason}"))
        return None


class _TooStiff(Exception):
    """An integrator's steps have become too many."""


def energy_drift(model: EmittedModel, windows: Windows) -> float | None:
    """Largest |H(t) - H(0)| over 1 s without input and dissipation, relative to the largest kinetic energy
    met.

    From the windows' fastest states, integrated to thirteen digits, so that what is left is the model's own.
    None where that cannot be done.
    """
    q, qd = windows.q[:, 0], windows.qd[:, 0]
    p = model.momentum(q, qd)
    kinetic = model.hamiltonian(q, p) - model.potential_energy(q)
    fastest = kinetic.topk(min(DRIFT_STATES, len(windows))).indices
    start = torch.cat([q[fastest], p[fastest]], dim=-1)

    calls = 0

    def undamped(t: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        if calls > DRIFT_CALLS:
            raise _TooStiff
        q, p = state.chunk(2, dim=-1)
        qd = model.velocity(q, p)
        friction = (model.dissipation(q, qd) @ qd.unsqueeze(-1)).squeeze(-1)
        return model.forward(t, state) + torch.cat([torch.zeros_like(q), friction], dim=-1)

    times = torch.linspace(0.0, DRIFT_SECONDS, DRIFT_TIMES, dtype=q.dtype)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchdiffeq hands SciPy an option that has no effect
        try:
            # SciPy's Dormand-Prince of order 8: torchdiffeq's own keeps to eight digits only
            states = odeint(undamped, start, times, method="scipy_solver", **DRIFT_SOLVER)
        except _TooStiff:
            return None
        q, p = states.chunk(2, dim=-1)
        energy = model.hamiltonian(q, p)
        moved = (energy - model.potential_energy(q)).max().item()
        drift = (energy - energy[0]).abs().max().item() / moved if moved > 0 else math.nan
    return drift if math.isfinite(drift) else None
