"""How a run is configured, and the logs it trains on: read, doubted, split, filtered, cut into windows."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from spelgen.errors import Diagnostic
from spelgen.fitting.rollout import LossScales, loss_scales
from spelgen.logs.checks import examine
from spelgen.logs.epoch_windows import WindowStream
from spelgen.logs.filtering import automatic_cutoff, automatic_spacing, prepare
from spelgen.logs.mapping import LogMapping
from spelgen.logs.read import Trajectory, read_logs
from spelgen.logs.trajectory import rate
from spelgen.logs.windows import Windows, cut_windows, split_validation, thinned
from spelgen.settings.training import TrainingSettings

FEW_WINDOWS = 1024  # of which L-BFGS takes all at once
WHOLE_DECAY, BATCH_DECAY = 2e-5, 0.2
Optimiser = Literal["adamw", "lbfgs"]

LARGEST_VALIDATION = 2048  # windows; validation is a measurement, it needs no more


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of one run; see `TrainingSettings` for those that a robot's sidecar file may set.

    objective: torque (see `start_from_torque`) or rollout; None: torque for a closed-form model, else rollout.
    momentum_steps: steps on the weak form of the equations before windows are predicted; 0: none.
    prior: weight of staying near the URDF's own M and gravity (see `Prior`); 0: none.
    every: samples from one sample of a window to the next, None: see `automatic_spacing`.
    optimiser: None: by the number of windows. weight_decay: AdamW's, or L-BFGS's penalty; None: by the optimiser.
    substeps: rk4 steps per sample interval, None: chosen by `choose_substeps`.
    filter: cutoff [Hz] of the zero-phase low-pass on q, qd and tau; 0: none; None: see `automatic_cutoff`.
    threads: of torch; the matrices are tiny, more than two rarely help. compile: the right-hand side by torch.
    max_minutes: the learning rate is annealed within this time too.
    """

    objective: Literal["torque", "momentum", "rollout"] | None = None
    momentum_steps: int = 2000
    prior: float = 1.0
    window: int = 5
    stride: int = 1
    every: int | None = None
    epochs: int = 400
    batch: int = 256
    learning_rate: float = 1e-3
    weight_decay: float | None = None
    optimiser: Optimiser | None = None
    substeps: int | None = None
    validation_fraction: float = 0.25
    patience: int = 60
    seed: int = 0
    filter: float | None = None
    device: str = "cpu"
    threads: int = 1
    compile: bool = False
    max_minutes: float | None = None

    def whole(self, windows: int) -> bool:
        """Whether so many windows are trained on all at once."""
        return self.optimiser == "lbfgs" or (self.optimiser is None and windows <= FEW_WINDOWS)

    def decay(self, windows: int) -> float:
        """Weight decay for so many windows."""
        if self.weight_decay is not None:
            return self.weight_decay
        return WHOLE_DECAY if self.whole(windows) else BATCH_DECAY

    @classmethod
    def from_settings(cls, settings: TrainingSettings, **flags: Any) -> TrainingConfig:
        """A sidecar file's settings, overridden by every flag that is not None."""
        known = {field.name for field in fields(cls)}
        chosen = {name: value for name, value in settings.model_dump().items() if name in known}
        return cls(**(chosen | {name: value for name, value in flags.items() if value is not None}))


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Windows of the logs, ready to train on.

    training: all of them, or where the logs are larger than memory an even sample, and `stream` draws those
    that are trained on. digest: of every number, to resume on the same data only. recordings: what all was cut
    from, validation included, where it fits into memory.
    """

    training: Windows
    validation: Windows
    scales: LossScales
    cutoff: float | None
    training_names: tuple[str, ...]
    validation_names: tuple[str, ...]
    diagnostics: tuple[Diagnostic, ...]
    digest: str
    stream: WindowStream | None = None
    recordings: tuple[Trajectory, ...] = ()

    @property
    def size(self) -> int:
        """Windows there are to train on."""
        return len(self.training if self.stream is None else self.stream)


def prepare_data(
    paths: Iterable[Path | str],
    joints: Sequence[str],
    joint_types: Sequence[str],
    config: TrainingConfig,
    mapping: LogMapping | None = None,
) -> TrainingData:
    """Read the logs' training part, as `mapping` says, and make windows of it.

    Validation trajectories are set aside before anything is cut, so that no sample is in both parts.
    Raises LogError, and SettingsError where the mapping does not fit.
    """
    trajectories = read_logs(paths, joints, role="train", mapping=mapping, joint_types=joint_types)
    notes = examine(trajectories, joints, joint_types)
    split = split_validation(trajectories, config.validation_fraction, config.seed)
    rates = [rate(x) for x in trajectories]
    cutoff = filter_cutoff(config.filter, rates)
    notes += filter_note(cutoff)
    every = config.every or automatic_spacing(rates, cutoff)
    training, validation = (
        prepare(x, shortest=(config.window - 1) * every + 1, cutoff=cutoff)
        for x in (split.training, split.validation)
    )
    windows = cut_windows(training, config.window, config.stride, every, measured=cutoff is not None)
    return TrainingData(
        training=windows,
        validation=thinned(
            cut_windows(validation, config.window, config.stride, every, measured=cutoff is not None),
            LARGEST_VALIDATION,
        ),
        scales=loss_scales(windows, joint_types),
        cutoff=cutoff,
        training_names=tuple(x.name for x in split.training),
        validation_names=tuple(x.name for x in split.validation),
        diagnostics=(*notes, split.note),
        digest=digest(trajectories),
        recordings=tuple(trajectories),
    )


def filter_cutoff(asked: float | None, rates: Iterable[float]) -> float | None:
    """The low-pass cutoff [Hz] for what a user asked: None chooses, 0 means no filter. rates: of the logs [Hz]."""
    return automatic_cutoff(rates) if asked is None else asked or None


def filter_note(cutoff: float | None) -> list[Diagnostic]:
    """That the logs are filtered, if they are."""
    if cutoff is None:
        return []
    message = f"q, qd and tau filtered at {cutoff:g} Hz, zero phase"
    return [Diagnostic("info", "filter", "logs", None, message)]


def digest(trajectories: Iterable[Trajectory]) -> str:
    """A fingerprint of every number."""
    numbers = hashlib.sha256()
    for trajectory in trajectories:
        for array in (trajectory.t, trajectory.q, trajectory.qd, trajectory.tau):
            numbers.update(array.tobytes())
    return numbers.hexdigest()
