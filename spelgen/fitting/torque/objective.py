"""Objective `torque`: fit inverse dynamics to the torques of all logs, then validate the model on windows."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, ClassVar

import torch

from spelgen.arm.actuation import Drives
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.parameters import without_idle_residuals
from spelgen.dynamics.protocol import known_past, motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.dataset import PreparedLogs, TrainingData, Validation, prepare_data
from spelgen.fitting.objective import Objective
from spelgen.fitting.torque.fit import TorqueSolution, fit_torque
from spelgen.fitting.torque.networks import BLOCK, adapt_networks, fit_networks
from spelgen.fitting.torque.report import torque_notes
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.identification.drive_hints import Coupling
from spelgen.identification.torque_delay import NO_DELAY, TorqueDelay, find_torque_delay
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.tuning import SLOWEST
from spelgen.logs.windows import thinned
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import TorqueFit

if TYPE_CHECKING:
    from spelgen.fitting.urdf_regularizer import UrdfRegularizer

SAMPLES = 5  # samples per window; windows only validate a torque fit, which is made on single samples
FITTED = {
    "load": "only a load at the tip fitted",
    "friction": "only friction and torque offsets fitted",
    "unit": "the differences of this unit fitted",
}


class TorqueObjective(Objective):
    """Objective of a fit to torques.

    `begin` runs the whole fit. A fit takes seconds to minutes, so no checkpoints are written during the fit.
    """

    name: ClassVar[str] = "torque"
    config: TorqueFit

    def prepare(self) -> PreparedLogs:
        """Estimate motor couplings and the torque delay from the logs, then check and prepare the logs."""
        preprocessing, self._delay = self.request.preprocessing, NO_DELAY
        self._coupling_notes: list[Diagnostic] = []
        if isinstance(self.model, RigidBodyDynamics):
            late = torque_delay(self.model, self.request.logs, preprocessing)
            if late.coupling and late.coupling[0].logged_at == "joints" and not self.config.adapt:
                self._coupling_notes = [couple_motors(self.model, *late.coupling)]
                late = torque_delay(self.model, self.request.logs, preprocessing)
            if preprocessing.torque_delay is None:
                self._delay = late
                preprocessing = replace(preprocessing, torque_delay=late.delay)
                self.request = replace(self.request, preprocessing=preprocessing)
        # Windows are only used for validation and for the scales of its loss, so their number is limited.
        stride = -(-sum(map(len, self.request.logs)) // TUNING.max_windows)
        self.data = prepare_data(self.request, SAMPLES, stride)
        return self.data

    def begin(self) -> list[Diagnostic]:
        """Fit the model and validate it; return diagnostics.

        Raises LogError if no log is sampled densely enough for accelerations.
        """
        model = self.model
        notes = [*self._coupling_notes, *self._delay.notes]
        samples = torque_samples(model, self.data)
        if samples is None:
            what = "to adapt to" if self.config.adapt else "to fit torques to"
            raise LogError(
                f"no motion {what}",
                expected=f"samples at {SLOWEST:g} Hz or more that move",
                do="fit windows: the objective rollout",
            )
        regularizer = None
        # The fit of rigid-body models has a prior at the URDF, so they need no regularizer.
        if self.config.urdf_weight and not isinstance(model, RigidBodyDynamics):
            from spelgen.fitting.urdf_regularizer import urdf_regularizer

            regularizer = urdf_regularizer(self.request.urdf, model, self.data.training, notes)
        fit_notes, solution = fit_torques(model, samples, self.config, regularizer)
        self.results = {"notes": [note.message for note in fit_notes]}
        notes += fit_notes
        # Residual terms that were not selected are zero. These terms are removed from the validated model to save time.
        subset = replace(self.data, validation=thinned(self.data.validation, TUNING.validation_windows))
        validation = Validation(without_idle_residuals(model), subset, self.request.options.device)
        substeps = validation.substeps()
        loss = validation.loss(substeps)
        self._make_checkpoint(loss, time.monotonic() - self.request.began, substeps)
        self._checkpoint["torque_nmse"] = torque_nmse(model, samples)
        # An adapted model has parameters of two fits, so the covariance of all its parameters is unknown.
        if solution is not None and not self.config.adapt:
            self._checkpoint["posterior"] = {
                "covariance": solution.covariance,
                "torque_std": solution.torque_std,
                # The half width of a 99 % interval is 2.576 standard deviations.
                "delay_std": self._delay.interval / 2.576,
            }
        return notes


def torque_nmse(model: ArmModel, samples: TorqueSamples) -> list[float]:
    """Return the nMSE of each joint: mean squared torque error divided by the variance of the torque (n values)."""
    tau = samples.columns.tau
    squares = torch.zeros(model.n, dtype=torch.float64)
    with torch.no_grad():
        for block in samples.blocks(BLOCK):
            past = known_past(model, block.z, block.direction)
            error = model.inverse_dynamics(block.q, block.qd, block.qdd, *past) - block.tau
            squares += error.square().sum(dim=0)
    return (squares / len(tau) / tau.var(dim=0, correction=0)).tolist()


def torque_delay(model: ArmModel, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> TorqueDelay:
    """Return the delay [s] of the torques relative to the positions, or instead the motor coupling, if one is detected.

    The delay is the one for which a least-squares fit of inertial and friction parameters has the smallest torque
    residual. With a motor coupling that the model lacks, the estimate would be biased: then no delay is estimated.
    """
    with torch.no_grad():
        inputs = model.input_matrix(torch.zeros(1, model.n).double())[0].numpy()
    drives = Drives(inputs, motors_of(model).numpy())
    return find_torque_delay(logs, model.joint_types, drives, model.chain, preprocessing)


def couple_motors(model: ArmModel, coupling: Coupling, remaining: float) -> Diagnostic:
    """Add a motor coupling to a model and its specification, and return the warning about the coupling.

    Without the coupling, the bodies would absorb the friction of a coupled wrist. Example: for a TX40 arm, the torque
    nMSE is 1.1 without and 0.02 with the coupling.

    Args:
        model: model in which the motor of `coupling.joint` drives this joint only.
        coupling: coupling that was detected in logs of joint torques.
        remaining: squared torque residual of both joints with the coupling, divided by the residual without it.
    """
    speeds = motors_of(model).clone()
    speeds[coupling.joint, coupling.moved_by] = coupling.ratio
    model.motors, model.loads = speeds, torch.linalg.inv(speeds)
    model.spec = replace(model.spec, motor_speeds=tuple(map(tuple, speeds.tolist())))
    joint, other = (model.joint_names[k] for k in coupling.pair)
    message = (
        f"the motor of {joint} turns with {other}, too, {coupling.ratio:g} times as fast: the squared torque residual "
        f"of both falls to {remaining:.0%} on samples that were not fitted; the fit has this coupling, add it to the "
        "settings (`spelgen logs` prints it)"
    )
    return Diagnostic("warning", "coupled-motors", "logs", None, message)


def torque_samples(model: ArmModel, data: TrainingData) -> TorqueSamples | None:
    """Return the samples of training and validation logs; None if no log has motion at a sufficient sample rate."""
    decimation, reach = 1, bristle_reach(model)
    if isinstance(model, RigidBodyDynamics):
        decimation = TUNING.decimation

    def moving() -> Iterator[DynamicsSamples]:
        for recording in data.recordings:
            samples = dynamics_samples([recording], preprocessing=data.preprocessing, reach=reach)
            yield from (x for x in samples if len(x.q))

    samples = moving()
    first = next(samples, None)
    return None if first is None else TorqueSamples.of(chain([first], samples), decimation)


def fit_torques(
    model: ArmModel, samples: TorqueSamples, config: TorqueFit, regularizer: UrdfRegularizer | None = None
) -> tuple[list[Diagnostic], TorqueSolution | None]:
    """Fit a model to samples; return diagnostics, and the solution if the model consists of rigid bodies.

    config: options of the fit. regularizer: for models of networks, penalty for differences from the URDF; None: none.
    """
    notes: list[Diagnostic] = []
    solution = None
    if isinstance(model, RigidBodyDynamics):
        solution = fit_torque(model, samples, config.prior, config.adapt)
        steps = solution.steps
        if not config.adapt:
            notes += torque_notes(model, samples, solution)
    elif config.adapt:
        steps = adapt_networks(model, samples, config.adapt, config.weight_decay, config.evaluations)
    else:
        penalty = None
        if regularizer is not None:
            penalty = lambda: config.urdf_weight * regularizer.loss(model)  # noqa: E731
        steps = fit_networks(model, samples, config.weight_decay, penalty, config.evaluations)
    message = (
        f"{FITTED.get(config.adapt or '', 'fitted')} to the torques of {samples.original_count} samples, "
        f"validation included, in {steps} steps"
    )
    return [Diagnostic("info", "torque-fit", "logs", None, message), *notes], solution
