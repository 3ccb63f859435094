"""Judge a trained run on test logs, beside its rivals, on the same windows and with the same integrator."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import Diagnostic
from spelgen.evaluation.baselines import Contender, held_velocity, trained, urdf_values
from spelgen.evaluation.examples import Example, predict_examples
from spelgen.evaluation.invariants import energy_drift
from spelgen.evaluation.results import Evaluation, Horizon, Tip, state_errors, torque_figures
from spelgen.evaluation.torque import torque_errors, torque_samples
from spelgen.fitting.dataset import filter_cutoff
from spelgen.fitting.rollout import choose_substeps, loss_scales
from spelgen.fitting.run_folder import RunFolder, trained_model, write_json
from spelgen.logs.checks import examine
from spelgen.logs.filtering import prepare
from spelgen.logs.mapping import LogMapping
from spelgen.logs.read import Trajectory, read_logs
from spelgen.logs.trajectory import rate
from spelgen.logs.windows import Windows, cut_windows
from spelgen.spec import Header, read_header

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

PREDICTED_STEPS = 40_000  # per horizon and contender: windows are thinned evenly to about this many
MOST_WINDOWS = 2000


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
            x.name: torque_figures(torque_errors(x.torque, samples))
            for x in contenders
            if x.torque and samples
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
    errors = {x.name: state_errors(x, windows, model.joint_types, tip) for x in contenders}
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
        return tip_kinematics(run.urdf, header.joints, header.options.tip).position
    except Exception as error:  # as above, of pytorch-kinematics
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        notes.append(Diagnostic("info", "no-tip", "robot.urdf", None, f"no tip errors: {reason}"))
        return None
