"""The result of a fit, in memory or from a run folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

import numpy as np
import torch

from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.dynamics.parameters import used_parameter_count
from spelgen.emission.assemble import ArmModel
from spelgen.errors import LogError, RunError
from spelgen.files import write_json
from spelgen.fitting.run_folder import RunFolder, fitted_model
from spelgen.fitting.run_record import Checkpoint, Content, Record
from spelgen.listing import Listing
from spelgen.logs.dynamics_samples import dynamics_samples
from spelgen.logs.filtering import low_pass
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, gap_ends, recordings
from spelgen.logs.tuning import SLOWEST
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.settings.fits import FitConfig
from spelgen.spec import ModelSpec

if TYPE_CHECKING:
    from spelgen.errors import Diagnostic
    from spelgen.fitting.objective import Status
    from spelgen.fitting.posterior import Posterior, Uncertain


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """A fitted model, the record of its fit, and the baselines that were fitted to the same logs.

    Attributes:
        history: lines of metrics.jsonl, one per epoch.
        diagnostics: messages about the logs and the fit.
        status: status with which the fit ended, such as "finished"; None for a run that was loaded.
        record: content of config.json.
        checkpoint: content of checkpoint.pt.
        baselines: content of least_squares.json, {} without baselines.
        urdf: URDF file of the robot, None if unknown.
        folder: run folder, None if the fit wrote no files.
        logs: trajectories for training and validation; () for a run that was loaded.
    """

    model: ArmModel
    history: Sequence[Content]
    diagnostics: tuple[Diagnostic, ...]
    status: Status | None
    record: Record
    checkpoint: Checkpoint
    baselines: Content
    urdf: Path | None = None
    folder: Path | None = None
    logs: Sequence[Trajectory] = ()

    @property
    def config(self) -> FitConfig:
        """The options of the fit that apply to the model, with all defaults set."""
        return self.record.config

    @property
    def preprocessing(self) -> Preprocessing:
        """The preprocessing of the logs, with all defaults set."""
        return self.record.preprocessing

    @property
    def epochs(self) -> int:
        """Number of completed epochs of the fit."""
        return self.checkpoint.epoch

    @property
    def best_validation(self) -> float:
        """Lowest validation loss: dimensionless `rollout_loss`; for position servos, RMS position error [rad, m]."""
        return self.checkpoint.best_loss

    @property
    def torque_nmse(self) -> dict[str, float]:
        """Mean squared torque error on the fitted samples divided by the variance of their torque, per joint name.

        Joints with constant torque are omitted.
        """
        by_joint = zip(self.model.joint_names, self.checkpoint.torque_nmse, strict=False)
        return {joint: nmse for joint, nmse in by_joint if math.isfinite(nmse)}

    @property
    def result(self) -> str:
        """Text with the mean and worst nMSE of the fitted torques or, without a torque fit, the validation loss."""
        nmse = self.torque_nmse
        if not nmse:
            return f"validation loss {self.best_validation:.3g}"
        worst = max(nmse, key=nmse.__getitem__)
        mean = sum(nmse.values()) / len(nmse)
        return (
            f"torque nMSE {mean:.3g}, at worst {nmse[worst]:.3g} ({worst}), of the samples that were fitted"
        )

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return used_parameter_count(self.model)

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of the model: 95 % intervals of the parameters, of M(q), g(q) and of predicted torques.

        Raises RunError unless rigid bodies were fitted to torques, or to positions under position servos.
        """
        # The posterior is imported here, since an evaluation does not need it.
        from spelgen.fitting.posterior import posterior_of

        delay = self.record.preprocessing.torque_delay or 0.0
        file = None if self.folder is None else RunFolder(self.folder).checkpoint
        return posterior_of(self.model, self.checkpoint.posterior, delay, file)

    @overload
    def predict(self, trajectory: Trajectory, *, std: Literal[False] = False) -> np.ndarray: ...
    @overload
    def predict(self, trajectory: Trajectory, *, std: Literal[True]) -> Uncertain: ...
    def predict(self, trajectory: Trajectory, *, std: bool = False) -> np.ndarray | Uncertain:
        """Return the torques (T, n) [Nm, N] of the model's inverse dynamics at the samples of a trajectory.

        The acceleration is the derivative of the velocity, which is filtered as in the fit. The torque is NaN at a
        single sample between two gaps in the sample times, since such a sample has no acceleration.

        Args:
            trajectory: trajectory of the arm.
            std: if True, return the pair `Uncertain` of torques and standard deviations (see `Posterior.torque`).
        """
        from spelgen.fitting.posterior import Uncertain

        (trajectory,) = recordings(trajectory, self.model.joint_names)
        reach = bristle_reach(self.model)
        tau, deviation = np.full_like(trajectory.q, np.nan), np.full_like(trajectory.q, np.nan)
        for start, stop in pairwise(gap_ends(trajectory.t, self.preprocessing.gap)):
            # A single sample between two gaps has no acceleration, so its torque remains NaN.
            if stop - start < 2:
                continue
            piece = trajectory[start:stop]
            # The zero-phase filter extends the signal at both ends, which requires more than three samples.
            if self.preprocessing.cutoff and len(piece) > 3:
                piece = low_pass(piece, self.preprocessing.cutoff)
            # Accelerations are not logged, so they are the derivative of the filtered velocity.
            qdd = np.gradient(piece.qd, piece.t, axis=0)
            motion = piece.q, piece.qd, qdd, bristles_along(piece.q, reach)
            if std:
                tau[start:stop], deviation[start:stop] = self.posterior.torque(*motion)
            else:
                tau[start:stop] = self._torque(*motion)
        return Uncertain(tau, deviation) if std else tau

    def score(self, logs: Trajectory | Sequence[Trajectory]) -> float:
        """Return 1 - nMSE of the torque on samples of ``logs`` in motion: 1: perfect, 0: as good as a constant torque.

        The score is the mean over trajectories of the mean over joints. Samples are selected and filtered by
        `dynamics_samples`. Raises LogError if no log is sampled densely enough for accelerations.
        """
        logs = recordings(logs, self.model.joint_names)
        reach = bristle_reach(self.model)
        samples = dynamics_samples(logs, preprocessing=self.preprocessing, reach=reach)
        samples = [x for x in samples if len(x.q)]
        if not samples:
            raise LogError(
                "no motion for an evaluation of torques",
                expected=f"samples at {SLOWEST:g} Hz or more that move",
            )
        scores = []
        for x in samples:
            squares = np.square(self._torque(x.q, x.qd, x.qdd, x.z, x.direction) - x.tau).mean(axis=0)
            variance = x.tau.var(axis=0)
            # The nMSE of a constant torque is undefined (division by zero), so joints of constant torque are omitted.
            varies = variance > 0
            scores.append(1 - (squares[varies] / variance[varies]).mean())
        return float(np.mean(scores))

    def save(self, folder: Path | str, *, force: bool = False) -> Path:
        """Write the same run folder as `spelgen train`; return its path.

        Raises RunError if there is a run in the folder, unless ``force``.
        """
        from spelgen.fitting.process import locked

        spec = required_spec(self.model)
        run = RunFolder(folder)
        with locked(run.path), run.started(spec, self.urdf, force=force):
            run.save(self.history, self.model.state_dict(), self.checkpoint.content)
            if self.baselines:
                write_json(run.baseline, self.baselines)
            write_json(run.config, self.record.to_dict())
        return run.path

    def _torque(self, *motion: np.ndarray | None) -> np.ndarray:
        """Return the torques (T, n) [Nm, N] of the model's inverse dynamics for arrays of motion.

        motion: q, qd, qdd, (T, n) each, then the friction state z and the direction of motion (see `DynamicsSamples`),
        None if unknown.
        """
        like = next(self.model.parameters())
        # Filters return views with negative strides. The views are copied, since torch does not accept them.
        inputs = [torch.as_tensor(np.ascontiguousarray(x)).to(like) for x in motion if x is not None]
        with torch.no_grad():
            return self.model.inverse_dynamics(*inputs).cpu().double().numpy()

    def __repr__(self) -> str:
        # A fit to torques has no epochs.
        end = f"{self.status} after {self.epochs} epochs" if self.epochs else self.status
        end = f"{end}, {self.result}" if end else self.result
        return f"<Fit of {self.record.robot!r} to {self.config.objective}: {end}>"

    def _repr_html_(self) -> str:
        rows = [
            ("robot", self.record.robot),
            ("objective", self.config.objective),
            ("parameters", f"{self.parameters}"),
            ("epochs", f"{self.epochs}"),
            ("result", self.result),
            *((name.replace("_", " "), f"{value}") for name, value in self.record.options.items()),
        ]
        return Listing("Fit", ("", ""), rows, left=(0, 1)).html()


def required_spec(model: PortHamiltonian) -> ModelSpec:
    """Return the specification of a model, which a run folder must contain. Raises RunError if the model has none."""
    if isinstance(model, ArmModel):
        return model.spec
    raise RunError(
        "a model without a specification, which a run folder cannot keep",
        expected="a model of spelgen.build or spelgen.load_module",
        do="keep the weights of this one by torch.save(model.state_dict(), FILE)",
    )


def load_run(folder: Path | str) -> Fit:
    """Return the fit in a run folder of `spelgen train` or `Fit.save`, with the best weights found.

    Raises RunError and ModuleError.
    """
    run = RunFolder(folder)
    # The record is read first, so that a missing run is reported before its model is assembled.
    record = run.read_record()
    # The gradients of a loaded model are disabled: the model is used for predictions only, and each prediction would
    # store its graph.
    return Fit(
        model=fitted_model(run).requires_grad_(False).eval(),
        history=run.read_metrics(),
        diagnostics=(),
        status=None,
        record=record,
        checkpoint=run.load_checkpoint(),
        baselines=run.read_baselines(),
        urdf=run.urdf if run.urdf.exists() else None,
        folder=run.path,
    )
