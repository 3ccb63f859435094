"""Training data: logs checked, split, filtered and cut into windows, and the validation of a model on them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.dynamics.bristles import BristleReach
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.rollout import LossScales, choose_substeps, loss_scales, rollout_loss
from spelgen.fitting.tuning import TUNING
from spelgen.logs.checks import check
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques
from spelgen.logs.windows import Split, Windows, cut_windows, split_validation, thinned
from spelgen.settings.fits import DEFAULTS, Solver


@dataclass(frozen=True)
class WindowChoice:
    """Choice of the windows for training and validation.

    validation: trajectories, or the fraction of the logs that validates: whole trajectories, chosen at random
    with `seed` before windows are cut, so that no sample is in both parts. window, stride, reach: see `cut_windows`.
    """

    window: int = 5
    stride: int = 1
    validation: float | Sequence[Trajectory] = 0.25
    seed: int = 0
    reach: BristleReach | None = None

    def span(self, preprocessing: Preprocessing) -> int:
        """Return the number of samples that one window spans, before decimation."""
        return (self.window - 1) * (preprocessing.decimation or 1) + 1

    def windows(self, trajectories: Sequence[Trajectory], preprocessing: Preprocessing) -> Windows:
        """Return all windows of the trajectories, whose gap-free pieces are filtered; preprocessing: resolved."""
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
    """Windows of the logs for training and validation.

    preprocessing: the resolved one. digest: of all numbers, so that a fit resumes on the same data only. recordings:
    all trajectories, with validation.
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


def prepare_data(
    trajectories: Sequence[Trajectory],
    joints: Sequence[str],
    joint_types: Sequence[str],
    preprocessing: Preprocessing,
    choice: WindowChoice = DEFAULT_CHOICE,
) -> TrainingData:
    """Check the logs, split them and cut windows. Raises LogError."""
    if not trajectories:
        raise LogError("no logs", expected="a trajectory or more")
    # Whole trajectories are set aside: neighbouring windows of one motion are not independent.
    split = _split(trajectories, choice)
    everything = list(trajectories)
    if not isinstance(choice.validation, float):
        everything += choice.validation
    for trajectory in everything:
        require_joints(trajectory, joints)
    require_torques(everything)
    notes = check(everything, joints, joint_types)
    # Resolved once for all logs: training and validation need the same filter.
    resolved = preprocessing.resolved([x.sample_rate for x in everything])
    windows = choice.windows(split.training, resolved)
    return TrainingData(
        training=windows,
        # A bounded number of windows: validation follows every epoch.
        validation=thinned(choice.windows(split.validation, resolved), TUNING.validation_windows),
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
    """Return the SHA-256 digest of all numbers of the trajectories."""
    numbers = hashlib.sha256()
    for x in trajectories:
        for array in (x.t, x.q, x.qd, x.tau, x.u):
            if array is not None:
                # The bytes of the arrays, without a copy of contiguous ones.
                numbers.update(np.ascontiguousarray(array).data)
    return numbers.hexdigest()


class Validation:
    """Validation windows, and a probe of the training windows for the integrator's steps.

    substeps: steps of rk4 between samples; None: chosen for the model. batch: of training; validation predicts four
    times as many windows together.
    """

    def __init__(
        self,
        model: ArmModel,
        data: TrainingData,
        device: str = "cpu",
        *,
        batch: int = DEFAULTS.batch,
        solver: Solver = "rk4",
        substeps: int | None = None,
    ) -> None:
        self.model = model.to(device)
        self.solver, self.prescribed = solver, substeps
        self.size = len(data.validation)
        self.scales = data.scales.to(device)
        # Larger batches than in training: no graph of derivatives is in memory.
        self.batches = data.validation.to(device).split(4 * batch)
        # Evenly spread windows, so that fast and slow parts of the motion are in the probe.
        self.probe = data.training[:: -(-len(data.training) // TUNING.probe_windows)].to(device)

    def loss(self, substeps: int) -> float:
        """Return `rollout_loss` of the validation windows; infinite if they diverge."""
        total = 0.0
        try:
            with torch.no_grad():
                for windows in self.batches:
                    loss = rollout_loss(self.model, windows, self.scales, substeps, self.solver)
                    # Weighted by size: the last batch may be smaller.
                    total += loss.item() * len(windows)
        except torch.linalg.LinAlgError:
            return math.inf
        return total / self.size

    def substeps(self, present: int | None = None) -> int:
        """Return the number of integration steps per sample interval: as prescribed, or chosen for the model.

        present: lower bound of the chosen number.
        """
        if self.solver != "rk4":
            return 1
        if self.prescribed is not None:
            return self.prescribed
        return choose_substeps(self.model, self.probe, self.scales, start=present or 1)

    def measure(self) -> tuple[int, float]:
        """Return the integration steps that the model needs between samples, and its validation loss."""
        substeps = self.substeps()
        return substeps, self.loss(substeps)
