"""The logs that a model is fitted to: checked, split, filtered, cut into windows."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.dynamics.bristles import BristleReach
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.rollout import LossScales, loss_scales
from spelgen.logs.checks import check
from spelgen.logs.chunks import Chunk
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques
from spelgen.logs.windows import Split, Windows, cut_windows, split_validation, thinned, window_count
from spelgen.settings.tuning.fitting import ValidationTuning

TUNING = ValidationTuning()


@dataclass(frozen=True)
class WindowChoice:
    """Which windows are cut, and which are set aside.

    validation: trajectories, or the fraction of the logs that is set aside, whole trajectories drawn by the seed
    before anything is cut, so that no sample is in both parts. window, stride, reach: see `cut_windows`.
    """

    window: int = 5
    stride: int = 1
    validation: float | Sequence[Trajectory] = 0.25
    seed: int = 0
    reach: BristleReach | None = None


DEFAULT_CHOICE = WindowChoice()


@dataclass(frozen=True, eq=False)
class WindowCutting:
    """How the chosen windows are cut of logs that are prepared like this. preprocessing: a resolved one."""

    choice: WindowChoice
    preprocessing: Preprocessing

    @property
    def decimation(self) -> int:
        """Samples from one sample of a window to the next."""
        return self.preprocessing.decimation or 1

    @property
    def shortest(self) -> int:
        """Samples of one window."""
        return (self.choice.window - 1) * self.decimation + 1

    def count(self, samples: int) -> int:
        """Return how many windows a gap-free piece of so many samples has."""
        return window_count(samples, self.choice.window, self.choice.stride, self.decimation)

    def windows(self, trajectories: Sequence[Trajectory]) -> Windows:
        """Return all windows of these trajectories, filtered piece by piece."""
        pieces = self.preprocessing.pieces(trajectories, shortest=self.shortest)
        filtered, choice = self.preprocessing.filtered, self.choice
        return cut_windows(
            pieces, choice.window, choice.stride, self.decimation, measured=filtered, reach=choice.reach
        )


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Windows of the logs, ready to fit.

    training: all of them, or of logs larger than memory an even sample. size: windows of all training logs.
    preprocessing: as it was resolved. digest: of every number, to resume on the same data only.
    recordings: what all was cut from, validation included; of logs larger than memory chunks.
    """

    training: Windows
    validation: Windows
    size: int
    scales: LossScales
    preprocessing: Preprocessing
    training_names: tuple[str, ...]
    validation_names: tuple[str, ...]
    diagnostics: tuple[Diagnostic, ...]
    digest: str
    recordings: tuple[Trajectory, ...] = ()
    chunks: tuple[Chunk, ...] = ()


def prepare_data(
    trajectories: Sequence[Trajectory],
    joints: Sequence[str],
    joint_types: Sequence[str],
    preprocessing: Preprocessing,
    choice: WindowChoice = DEFAULT_CHOICE,
) -> TrainingData:
    """Check the logs and make windows of them. Raises LogError."""
    if not trajectories:
        raise LogError("no logs", expected="a trajectory or more")
    split = _split(trajectories, choice)
    everything = list(trajectories)
    if not isinstance(choice.validation, float):
        everything += choice.validation
    for trajectory in everything:
        require_joints(trajectory, joints)
    require_torques(everything)
    notes = check(everything, joints, joint_types)
    resolved = preprocessing.resolved([x.sample_rate for x in everything])
    cutting = WindowCutting(choice, resolved)
    windows = cutting.windows(split.training)
    return TrainingData(
        training=windows,
        validation=thinned(cutting.windows(split.validation), TUNING.windows),
        size=len(windows),
        scales=loss_scales(windows, joint_types),
        preprocessing=resolved,
        training_names=tuple(x.name for x in split.training),
        validation_names=tuple(x.name for x in split.validation),
        diagnostics=(*notes, *resolved.diagnostics, split.note),
        digest=digest(everything),
        recordings=tuple(everything),
    )


def _split(trajectories: Sequence[Trajectory], choice: WindowChoice) -> Split:
    if isinstance(choice.validation, float):
        return split_validation(trajectories, choice.validation, choice.seed)
    message = f"validation on {len(choice.validation)} trajectories that were given"
    note = Diagnostic("info", "validation-split", "logs", None, message)
    return Split(tuple(trajectories), tuple(choice.validation), note)


def digest(trajectories: Iterable[Trajectory]) -> str:
    """Return a fingerprint of every number."""
    numbers = hashlib.sha256()
    for trajectory in trajectories:
        for array in numbers_of(trajectory):
            numbers.update(array)
    return numbers.hexdigest()


def numbers_of(trajectory: Trajectory) -> Iterator[memoryview]:
    """Yield what is digested of a trajectory."""
    for array in (trajectory.t, trajectory.q, trajectory.qd, trajectory.tau, trajectory.u):
        if array is not None:
            yield np.ascontiguousarray(array).data
