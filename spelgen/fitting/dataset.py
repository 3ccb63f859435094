"""The logs that a model is fitted to: checked, split, filtered, cut into windows."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spelgen.dynamics.bristles import BristleReach, reach_of
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.rollout import LossScales, loss_scales
from spelgen.logs.checks import check
from spelgen.logs.epoch_windows import EpochWindows, WindowCutting
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, gap_ends, require_joints, require_torques
from spelgen.logs.windows import Split, Windows, split_validation, thinned

if TYPE_CHECKING:
    from spelgen.logs.chunks import Chunk
    from spelgen.settings.fits import WindowConfig

LARGEST_VALIDATION = 2048  # windows; validation is a measurement, it needs no more


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Windows of the logs, ready to fit.

    training: all of them, or where the logs are larger than memory an even sample, and `stream` draws those
    that are fitted. preprocessing: as it was resolved. digest: of every number, to resume on the same data only.
    recordings: what all was cut from, validation included; of logs larger than memory chunks. counts: training windows
    of each trajectory; none of logs larger than memory.
    """

    training: Windows
    validation: Windows
    scales: LossScales
    preprocessing: Preprocessing
    training_names: tuple[str, ...]
    validation_names: tuple[str, ...]
    diagnostics: tuple[Diagnostic, ...]
    digest: str
    recordings: tuple[Trajectory, ...] = ()
    chunks: tuple[Chunk, ...] = ()
    stream: EpochWindows | None = None
    counts: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Windows there are to fit."""
        return len(self.training if self.stream is None else self.stream)


def prepare_data(
    trajectories: Sequence[Trajectory],
    joints: Sequence[str],
    joint_types: Sequence[str],
    config: WindowConfig,
    preprocessing: Preprocessing,
    validation: float | Sequence[Trajectory] = 0.25,
    seed: int = 0,
    reach: BristleReach | None = None,
) -> TrainingData:
    """Check the logs and make windows of them.

    validation: trajectories, or the fraction of the logs that is set aside, whole trajectories drawn by the seed
    before anything is cut, so that no sample is in both parts. reach: see `cut_windows`. Raises LogError.
    """
    if not trajectories:
        raise LogError("no logs", expected="a trajectory or more")
    split = _split(trajectories, validation, seed)
    everything = [*trajectories] if isinstance(validation, float) else [*trajectories, *validation]
    for trajectory in everything:
        require_joints(trajectory, joints)
    require_torques(everything)
    notes = check(everything, joints, joint_types)
    resolved = preprocessing.resolved([x.sample_rate for x in everything])
    cutting = WindowCutting(config.window, config.stride, resolved, reach)
    windows = cutting.windows(split.training)
    return TrainingData(
        training=windows,
        validation=thinned(cutting.windows(split.validation), LARGEST_VALIDATION),
        scales=loss_scales(windows, joint_types),
        preprocessing=resolved,
        training_names=tuple(x.name for x in split.training),
        validation_names=tuple(x.name for x in split.validation),
        diagnostics=(*notes, *resolved.diagnostics, split.note),
        digest=digest(everything),
        recordings=tuple(everything),
        counts=tuple(
            sum(map(cutting.count, np.diff(gap_ends(x.t, resolved.gap)).tolist())) for x in split.training
        ),
    )


def known_reach(reach: BristleReach | None, joint_types: Sequence[str]) -> BristleReach:
    """That of a model's bristles (n, K) [rad, m]; the usual ones where it has none, for what it is compared with."""
    return reach if reach is not None and reach.elements else reach_of(joint_types)


def _split(trajectories: Sequence[Trajectory], validation: float | Sequence[Trajectory], seed: int) -> Split:
    if isinstance(validation, float):
        return split_validation(trajectories, validation, seed)
    message = f"validation on {len(validation)} trajectories that were given"
    note = Diagnostic("info", "validation-split", "logs", None, message)
    return Split(tuple(trajectories), tuple(validation), note)


def digest(trajectories: Iterable[Trajectory]) -> str:
    """A fingerprint of every number."""
    numbers = hashlib.sha256()
    for trajectory in trajectories:
        for array in (trajectory.t, trajectory.q, trajectory.qd, trajectory.tau):
            numbers.update(np.ascontiguousarray(array).data)
    return numbers.hexdigest()
