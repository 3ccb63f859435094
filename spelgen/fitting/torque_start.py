"""What precedes windows for a closed-form model: the fit to all logs' torques, after which most are done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from spelgen.errors import Diagnostic, LogError, RunError
from spelgen.fitting.dataset import TrainingConfig, TrainingData
from spelgen.fitting.gaussian_prior import Belief
from spelgen.fitting.torque_fit import fit_torque
from spelgen.fitting.torque_networks import fit_networks
from spelgen.fitting.urdf_regularizer import Prior
from spelgen.identification.samples import DENSE, DynamicsSamples, dynamics_samples

if TYPE_CHECKING:
    from spelgen.fitting.run_folder import EmittedModel


LOAD = Belief(bodies=10.0)
"""Nothing is believed of a load."""


def last_body(model: Any) -> int:
    """The body that holds the tip, and what the tip holds."""
    return int(model.bodies.shape[0]) - 1


def is_closed_form(model: EmittedModel) -> bool:
    """Whether the torque fit knows what to do with this module."""
    return hasattr(model, "inertial_parameters")


def start_from_torque(
    model: EmittedModel,
    data: TrainingData,
    config: TrainingConfig,
    *,
    fit: bool,
    loaded: bool = False,
    prior: Prior | None = None,
) -> tuple[TrainingConfig, list[Diagnostic]]:
    """Fit a closed-form model, or with the objective ``torque`` any, to the torques of all recordings; the config
    for what is left to do, and notes.

    Nothing is left unless the objective is ``rollout``. Logs sampled too slowly for accelerations, or larger
    than memory, leave all to the predicted windows. ``loaded``: the weights are those of the arm without a load,
    and only the last body's move. Without ``fit`` the weights stay, as in a run that is resumed.
    ``prior``: what pulls a model of networks. Raises RunError where a load meets one, LogError for a load without
    samples.
    """
    if not is_closed_form(model):
        if loaded:
            raise RunError("a load for a model of networks", expected="a module of the preset closed-form")
        if config.objective == "momentum":
            return replace(config, epochs=0), []
        if config.objective != "torque":
            return config, []
    elif config.objective == "momentum":
        raise RunError("the objective 'momentum' for a closed-form model", expected="torque or rollout")
    samples = dynamics_samples(data.recordings)
    if not any(len(x.q) for x in samples):
        if loaded:
            raise LogError(
                "no motion to fit a load to", expected=f"samples at {DENSE:g} Hz or more that move"
            )
        message = f"no torque fit: these logs are sampled below {DENSE:g} Hz, or larger than memory"
        return config, [Diagnostic("warning", "no-torque-fit", "logs", None, message)]
    notes = []
    if fit:
        steps = _fitted(model, samples, config, loaded=loaded, prior=prior)
        what = "the last body alone fitted" if loaded else "fitted"
        message = (
            f"{what} to the torques of {sum(len(x.q) for x in samples)} samples, those of validation included"
        )
        notes = [Diagnostic("info", "torque-fit", "logs", None, f"{message}, in {steps} steps")]
    if config.objective != "rollout":
        config = replace(config, epochs=0, momentum_steps=0)
    return config, notes


def _fitted(
    model: EmittedModel,
    samples: Sequence[DynamicsSamples],
    config: TrainingConfig,
    *,
    loaded: bool,
    prior: Prior | None,
) -> int:
    """Fit the model; the steps it took."""
    if loaded:
        return fit_torque(model, samples, LOAD, [last_body(model)]).steps
    if is_closed_form(model):
        return fit_torque(model, samples).steps
    decay = config.decay(0)  # that of all samples at once
    if prior is None:
        return fit_networks(model, samples, decay)
    return fit_networks(model, samples, decay, lambda: config.prior * prior.loss(model))
