"""Arguments of a fit, preparation of the logs (checks, split, filter, windows), and the loss on validation windows."""

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from spelgen.dynamics.bristles import bristle_reach
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic
from spelgen.fitting.rollout import LossScales, choose_substeps, loss_scales, rollout_loss
from spelgen.fitting.tuning import TUNING
from spelgen.logs.checks import check, joint_kinds
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques
from spelgen.logs.windows import Split, Windows, cut_windows, split_validation, thinned
from spelgen.settings.fits import DEFAULTS, FitConfig, Solver
from spelgen.settings.log_mapping import LogMapping


@dataclass(frozen=True)
class RunOptions:
    """Options of the run of a fit: resources, files, messages.

    Attributes:
        device: torch device.
        threads: number of threads of torch.
        resume: continue from the checkpoint of the run folder; the result is the same as without an interruption.
        force: replace a run in the folder.
        progress: show the progress on stderr.
        mapping: names and units of the columns of the logs; the run folder gets a copy.
        notes: diagnostics that the caller has already, for example from reading the logs; the fit reports them with its
            own diagnostics.
        began: start of the time limit, as a value of `time.monotonic` [s]; None: the call of `fit`.
    """

    device: str = "cpu"
    threads: int = 1
    resume: bool = False
    force: bool = False
    progress: bool = False
    mapping: LogMapping | None = None
    notes: Sequence[Diagnostic] = ()
    began: float | None = None


@dataclass(frozen=True)
class FitRequest:
    """The arguments of `fit` with all default values resolved.

    Attributes:
        validation: fraction of the logs that is set aside for validation, or the validation trajectories.
        urdf: URDF file of the robot, None if unknown.
        began: start of the time limit, as a value of `time.monotonic` [s].
        folder: run folder, None if the fit writes no files.
    """

    model: ArmModel
    logs: Sequence[Trajectory]
    config: FitConfig
    preprocessing: Preprocessing
    validation: float | Sequence[Trajectory]
    seed: int
    urdf: Path | None
    options: RunOptions
    began: float
    folder: Path | None

    @property
    def recordings(self) -> list[Trajectory]:
        """All trajectories of the fit, for training and validation."""
        return [*self.logs, *(() if isinstance(self.validation, float) else self.validation)]


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedLogs:
    """Properties of the checked logs, which the run folder stores.

    Attributes:
        preprocessing: filter, gaps and delay, with all automatic values resolved.
        digest: SHA-256 of all numbers of the logs; a fit resumes only on logs with the same digest.
        training_names, validation_names: names of the trajectories.
        window_counts: number of training windows and of validation windows.
        diagnostics: messages about the logs for the user.
        scales: divisors of the errors of q, qd and tau in the validation loss; None if the objective has no validation
            loss.
    """

    preprocessing: Preprocessing
    digest: str
    training_names: Sequence[str]
    validation_names: Sequence[str] = ()
    window_counts: tuple[int, int]
    diagnostics: Sequence[Diagnostic]
    scales: LossScales | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingData(PreparedLogs):
    """Prepared logs with their windows.

    training, validation: windows for the training loss and for the validation loss. recordings: all trajectories from
    which the windows were cut.
    """

    training: Windows
    validation: Windows
    scales: LossScales
    recordings: Sequence[Trajectory]


def prepare_data(request: FitRequest, window: int, stride: int) -> TrainingData:
    """Check the logs of a fit, split them into training and validation, and cut windows. Raises LogError.

    Args:
        request: arguments of the fit; the model, the logs and their preprocessing are used.
        window: number of samples per window.
        stride: number of samples between the starts of successive windows.
    """
    # Whole trajectories are set aside for validation: neighbouring windows of one motion are not independent.
    if isinstance(request.validation, float):
        split = split_validation(request.logs, request.validation, request.seed)
    else:
        message = f"validation on {len(request.validation)} trajectories that were given"
        note = Diagnostic("info", "validation-split", "logs", None, message)
        split = Split(tuple(request.logs), tuple(request.validation), note)
    model, recordings = request.model, request.recordings
    for trajectory in recordings:
        require_joints(trajectory, model.joint_names)
    require_torques(recordings)
    notes = check(recordings, model.joint_names, joint_kinds(model.joints))
    # The preprocessing is resolved once for all logs, so that training and validation have the same filter.
    resolved = request.preprocessing.resolved([x.sample_rate for x in recordings])
    decimation, reach = resolved.decimation or 1, bristle_reach(model)

    def windows(trajectories: Sequence[Trajectory]) -> Windows:
        """Return windows of ``window`` samples, cut from the filtered segments between gaps in the sample times."""
        pieces = resolved.pieces(trajectories, shortest=(window - 1) * decimation + 1)
        return cut_windows(pieces, window, stride, decimation, measured=resolved.filtered, reach=reach)

    training = windows(split.training)
    # The number of validation windows is bounded, since every epoch ends with a validation.
    validation = thinned(windows(split.validation), TUNING.validation_windows)
    return TrainingData(
        training=training,
        validation=validation,
        # The loss scales are computed from the training windows only, since validation logs must not change the loss
        # function.
        scales=loss_scales(training, model.joint_types),
        preprocessing=resolved,
        training_names=[x.name for x in split.training],
        validation_names=[x.name for x in split.validation],
        window_counts=(len(training), len(validation)),
        diagnostics=(*notes, *resolved.diagnostics, split.note),
        digest=digest(recordings),
        recordings=recordings,
    )


def digest(trajectories: Iterable[Trajectory]) -> str:
    """Return the SHA-256 digest of all numbers of the trajectories, by which a resumed fit recognizes its logs."""
    numbers = hashlib.sha256()
    for x in trajectories:
        for array in (x.t, x.q, x.qd, x.tau, x.u):
            if array is not None:
                # `.data` gives access to the bytes of an array without a copy, if the array is contiguous.
                numbers.update(np.ascontiguousarray(array).data)
    return numbers.hexdigest()


class Validation:
    """Validation loss of a model, and the number of integration steps that makes the integration error small.

    The number of integration steps is chosen on a few training windows, `probe`.

    substeps: rk4 steps per sample interval; None: `choose_substeps` chooses the number. batch: number of windows per
    training batch; a validation batch has four times as many windows.
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
        # Validation batches are four times as large as training batches: no derivatives are computed, which saves
        # memory.
        self.batches = data.validation.to(device).split(4 * batch)
        # The windows of the probe, on which the number of integration steps is chosen, are evenly spread over the
        # training windows: they contain fast and slow motion.
        self.probe = data.training[:: -(-len(data.training) // TUNING.probe_windows)].to(device)

    def loss(self, substeps: int) -> float:
        """Return the dimensionless `rollout_loss` of the validation windows; infinite if a rollout diverges.

        substeps: number of integration steps per sample interval.
        """
        total = 0.0
        try:
            with torch.no_grad():
                for windows in self.batches:
                    loss = rollout_loss(self.model, windows, self.scales, substeps, self.solver)
                    # Batches are weighted by their number of windows: the last batch may be smaller.
                    total += loss.item() * len(windows)
        except torch.linalg.LinAlgError:
            return math.inf
        return total / self.size

    def substeps(self, present: int | None = None) -> int:
        """Return the number of integration steps per sample interval.

        For the adaptive solver dopri5 the number is 1. For rk4 it is the constructor's argument `substeps` or, if this
        is None, the smallest number with a small integration error (see `choose_substeps`).

        present: number of steps in use, a lower bound of the number that is chosen; None: 1.
        """
        if self.solver != "rk4":
            return 1
        if self.prescribed is not None:
            return self.prescribed
        return choose_substeps(self.model, self.probe, self.scales, start=present or 1)

    def measure(self) -> tuple[int, float]:
        """Return the integration steps per sample interval (see `substeps`), and the validation loss with them."""
        substeps = self.substeps()
        return substeps, self.loss(substeps)
