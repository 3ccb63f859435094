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
from spelgen.logs.windows import Split, Windows, cut_windows, split_validation, thinned
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

    def span(self, preprocessing: Preprocessing) -> int:
        """Return the samples of one window, of logs that are prepared like this."""
        return (self.window - 1) * (preprocessing.decimation or 1) + 1

    def windows(self, trajectories: Sequence[Trajectory], preprocessing: Preprocessing) -> Windows:
        """Return all windows of these trajectories, filtered piece by piece; preprocessing: a resolved one."""
        return cut_windows(
            preprocessing.pieces(trajectories, shortest=self.span(preprocessing)),
            self.window,
            self.stride,
            preprocessing.decimation or 1,
            measured=preprocessing.filtered,
            reach=self.reach,
        )


DEFAULT_CHOICE = WindowChoice()


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Windows of the logs, ready to fit.

    training: all of them, or of logs larger than memory an even sample. preprocessing: as it was resolved.
    digest: of every number, to resume on the same data only. recordings: what all was cut from, validation included; of
    logs larger than memory chunks.
    """

    training: Windows
    validation: Windows
    scales: LossScales
    preprocessing: Preprocessing
    training_names: tuple[str, ...]
    validation_names: tuple[str, ...]
    diagnostics: tuple[Diagnostic, ...]
    digest: str
    recordings: Sequence[Trajectory] = ()
    chunks: Sequence[Chunk] = ()


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
    windows = choice.windows(split.training, resolved)
    return TrainingData(
        training=windows,
        validation=thinned(choice.windows(split.validation, resolved), TUNING.windows),
        scales=loss_scales(windows, joint_types),
        preprocessing=resolved,
        training_names=tuple(x.name for x in split.training),
        validation_names=tuple(x.name for x in split.validation),
        diagnostics=(*notes, *resolved.diagnostics, split.note),
        digest=digest(everything),
        recordings=everything,
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
