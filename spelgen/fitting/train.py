"""Train an emitted module on logs by predicting short windows of them (SPEL, Algorithm 1, no PD penalty)."""

from __future__ import annotations

import hashlib
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from spelgen.errors import Diagnostic, ModuleError, RunError
from spelgen.fitting.compiled import compiled
from spelgen.fitting.dataset import TrainingConfig, TrainingData, prepare_data
from spelgen.fitting.loop import Status, TrainingLoop
from spelgen.fitting.progress import TrainingProgress
from spelgen.fitting.run_folder import RunFolder, load_model, write_json
from spelgen.fitting.streaming import prepare_streamed
from spelgen.fitting.torque_start import is_closed_form, start_from_torque
from spelgen.fitting.urdf_regularizer import Prior, urdf_prior
from spelgen.logs.chunks import large_files
from spelgen.logs.mapping import LogMapping
from spelgen.spec import Header, read_header

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel

MAY_CHANGE = (
    "epochs",
    "patience",
    "max_minutes",
    "threads",
    "device",
    "compile",
)  # between a run and its resumption


@dataclass(frozen=True)
class RunResult:
    """How a training run ended. best_validation: of `rollout_loss`, without unit."""

    folder: Path
    status: Status
    epochs: int
    steps: int
    best_epoch: int
    best_validation: float
    seconds: float
    parameters: int
    substeps: int
    diagnostics: tuple[Diagnostic, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self) | {
            "folder": str(self.folder),
            "diagnostics": [x.to_dict() for x in self.diagnostics],
        }


def train(
    module: Path | str,
    data: Iterable[Path | str],
    folder: Path | str,
    config: TrainingConfig,
    *,
    urdf: Path | str | None = None,
    source: Path | str | None = None,
    mapping: LogMapping | None = None,
    resume: bool = False,
    force: bool = False,
    progress: bool = True,
) -> RunResult:
    """Train the emitted module on the logs and leave a run folder (see `RunFolder`).

    urdf: the robot the module was built from, for the rivals of `evaluate`; by default the file of that name
    beside the module. source: a run of this module, whose weights are adapted to a load at the tip: of a
    closed-form model the last body alone moves. mapping: how the logs are named and measured; by default as
    spelgen writes them, and when resumed as before. resume: go on from the folder's checkpoint, exactly as if
    there had been no interruption. Ctrl-C or SIGTERM end the run with status "interrupted"; the folder is usable and
    resumable. Raises ModuleError, LogError, and RunError when the folder holds a run or cannot be resumed
    with this.
    """
    run = RunFolder(Path(folder))
    module = Path(module)
    if resume:
        before = run.read_json(run.config)  # a missing run is told before anything is read
        mapping = mapping or LogMapping(**before.get("mapping", {}))
        module = run.module
    _use(config)
    model = load_model(module)
    if source is not None and not resume:
        adapted = RunFolder(Path(source))
        model.load_state_dict(adapted.load_state(adapted.weights))
    header = read_header(module)
    paths = list(data)
    large = large_files(paths, header.joints, role="train")
    prepared = (
        prepare_streamed(large, header.joints, model.joint_types, config, mapping)
        if large
        else prepare_data(paths, header.joints, model.joint_types, config, mapping)
    )
    description = _describe(config, prepared, header) | {
        "mapping": (mapping or LogMapping()).model_dump(exclude_defaults=True)
    }
    notes = list(prepared.diagnostics)
    stepped = _compiled(model, prepared, config, notes) if config.compile else model
    if resume:
        _require_same(run, description)
    else:
        robot, found = _robot(module, urdf, header)
        notes += found
        run.start(module, robot, force=force)
        write_json(run.config, description)
    # a closed-form model has its own beliefs while it is fitted to torques
    pulled = config.objective == "rollout" or not is_closed_form(model)
    prior = _prior(run, header, model, prepared, config, notes) if pulled else None
    config, told = start_from_torque(
        model, prepared, config, fit=not resume, loaded=source is not None, prior=prior
    )
    notes += told
    loop = TrainingLoop(run, model, prepared, config, prior, stepped)
    if resume:
        loop.restore()
    with TrainingProgress(config.epochs, show=progress) as shown, _termination_as_interrupt():
        for note in notes:
            shown.note(note)
        status = loop.run(shown)
    return _result(loop, status, tuple(notes))


def _result(loop: TrainingLoop, status: Status, notes: tuple[Diagnostic, ...]) -> RunResult:
    return RunResult(
        folder=loop.folder.path,
        status=status,
        epochs=loop.epoch,
        steps=loop.step,
        best_epoch=loop.best_epoch,
        best_validation=loop.best_loss,
        seconds=loop.seconds,
        parameters=sum(parameter.numel() for parameter in loop.model.parameters()),
        substeps=loop.substeps,
        diagnostics=notes,
    )


def _prior(
    run: RunFolder,
    header: Header,
    model: EmittedModel,
    data: TrainingData,
    config: TrainingConfig,
    notes: list[Diagnostic],
) -> Prior | None:
    """The URDF's pull, where it is wanted and can be had."""
    if not config.prior or not run.urdf.exists():
        return None
    try:
        return urdf_prior(run.urdf, header.joints, model, data.training)
    except Exception as error:  # Pinocchio and its parser raise many kinds; training goes on without
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        notes.append(
            Diagnostic("info", "no-prior", "robot.urdf", None, f"trained without the URDF's pull: {reason}")
        )
        return None


def _compiled(
    model: EmittedModel, data: TrainingData, config: TrainingConfig, notes: list[Diagnostic]
) -> EmittedModel:
    """The model as training steps use it, compiled before anything is written."""
    since = time.monotonic()
    windows = (
        data.training if config.whole(data.size) else data.training[: config.batch]
    )  # as steps take them
    ready = compiled(model.to(config.device), windows.to(config.device), data.scales.to(config.device))
    message = f"right-hand side compiled in {time.monotonic() - since:.0f} s"
    notes.append(Diagnostic("info", "compiled", "training", None, message))
    return ready


def _use(config: TrainingConfig) -> None:
    torch.set_num_threads(config.threads)
    try:
        torch.empty(0, device=config.device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise RunError(
            f"a device {config.device!r} that torch cannot use ({reason})", do="use --device cpu"
        ) from error


def _describe(config: TrainingConfig, data: TrainingData, header: Header) -> dict[str, Any]:
    """What goes into config.json."""
    return {
        "schema": 1,
        "robot": header.robot,
        "preset": header.options.preset,
        "joints": list(header.joints),
        "config": asdict(config),
        "data_digest": data.digest,
        "training": list(data.training_names),
        "validation": list(data.validation_names),
        "training_windows": data.size,
        "validation_windows": len(data.validation),
        "cutoff": data.cutoff,
        "scales": {name: getattr(data.scales, name).tolist() for name in ("q", "qd", "tau")},
    }


def _require_same(run: RunFolder, description: dict[str, Any]) -> None:
    """Refuse to resume with other data or settings than the run was started with."""
    started = run.read_json(run.config)
    if started["data_digest"] != description["data_digest"]:
        raise RunError(
            "other logs than the run was started with",
            file=run.path,
            do="give the same --data or start a new run",
        )
    before, now = started["config"], description["config"]
    changed = [name for name in now if name not in MAY_CHANGE and before.get(name) != now[name]]
    if changed:
        told = ", ".join(f"{name} {now[name]} instead of {before.get(name)}" for name in changed)
        raise RunError(
            told, file=run.path, expected="the settings the run was started with", do="or start a new run"
        )


def _robot(module: Path, urdf: Path | str | None, header: Header) -> tuple[Path | None, list[Diagnostic]]:
    """The URDF to copy into the run, and what there is to say about it."""
    path = module.with_name(header.urdf) if urdf is None else Path(urdf)
    if not path.is_file():
        if urdf is not None:
            raise RunError("no such file", file=path, expected="the URDF the module was built from")
        message = f"no {header.urdf} beside the module; evaluation will miss the URDF's own values as a rival"
        return None, [Diagnostic("info", "no-urdf", "run", None, message)]
    if hashlib.sha256(path.read_bytes()).hexdigest() == header.urdf_sha256:
        return path, []
    if urdf is not None:
        raise ModuleError(
            "another URDF than the module was built from", file=path, do="build the module again"
        )
    message = (
        f"{header.urdf} beside the module has changed since the module was built; it is left out of the run"
    )
    return None, [Diagnostic("warning", "changed-urdf", "run", None, message)]


@contextmanager
def _termination_as_interrupt() -> Iterator[None]:
    """SIGTERM ends training as Ctrl-C does. Only the main thread may set handlers; others change nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(signum: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
