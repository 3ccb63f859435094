"""The request of a fit, and its data: logs checked, split, filtered and cut into windows; validation on the windows."""

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from spelgen.dynamics.bristles import bristle_reach
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.rollout import LossScales, choose_substeps, loss_scales, rollout_loss
from spelgen.fitting.tuning import TUNING
from spelgen.logs.checks import check
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques
from spelgen.logs.windows import Split, Windows, cut_windows, split_validation, thinned
from spelgen.settings.fits import DEFAULTS, FitConfig, Solver
from spelgen.settings.log_mapping import LogMapping


@dataclass(frozen=True)
class RunOptions:
    """How a fit runs.

    device, threads: of torch. resume: continue from the folder's checkpoint, exactly as if there had been no
    interruption. force: replace a run. progress: show it on stderr. mapping: with which the logs were read, kept with
    the run. notes: earlier diagnostics, reported with the others. began: start of the allowed time (`time.monotonic`);
    None: now.
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
    """The arguments of a fit.

    validation: the fraction of the logs that is set aside, or trajectories. urdf: of the robot, None if unknown.
    began: start of the allowed time (`time.monotonic`). folder: of the run, None without one.
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
        """All logs, validation included."""
        return [*self.logs, *(() if isinstance(self.validation, float) else self.validation)]


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedLogs:
    """Logs that were checked, and the facts of them that a run folder records.

    preprocessing: the resolved one. digest: of all numbers, so that a fit resumes on the same data only.
    training_names, validation_names: of the logs. window_counts: for training and validation. diagnostics: for the
    user. scales: of the validation loss; None without one.
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
    """Windows of the logs for training and validation; recordings: all trajectories, with validation."""

    training: Windows
    validation: Windows
    scales: LossScales
    recordings: Sequence[Trajectory]


def prepare_data(request: FitRequest, window: int, stride: int) -> TrainingData:
    """Check the logs, split them and cut windows. Raises LogError.

    Args:
        request: of the fit.
        window: samples of a window.
        stride: samples between the starts of two windows.
    """
    if not request.logs:
        raise LogError("no logs", expected="a trajectory or more")
    # Whole trajectories are set aside: neighbouring windows of one motion are not independent.
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
    notes = check(recordings, model.joint_names, model.joint_types)
    # Resolved once for all logs: training and validation need the same filter.
    resolved = request.preprocessing.resolved([x.sample_rate for x in recordings])
    decimation, reach = resolved.decimation or 1, bristle_reach(model)

    def windows(trajectories: Sequence[Trajectory]) -> Windows:
        """Return all windows (W, K, n) of the filtered pieces between gaps."""
        pieces = resolved.pieces(trajectories, shortest=(window - 1) * decimation + 1)
        return cut_windows(pieces, window, stride, decimation, measured=resolved.filtered, reach=reach)

    training = windows(split.training)
    # A bounded number of windows: validation follows every epoch.
    validation = thinned(windows(split.validation), TUNING.validation_windows)
    return TrainingData(
        training=training,
        validation=validation,
        # of training windows only: validation logs must not change the loss
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
