"""What precedes windows for a closed-form model: the fit to all logs' torques, after which most are done."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from spelgen.errors import Diagnostic, RunError
from spelgen.identification.samples import DENSE, dynamics_samples
from spelgen.training.data import TrainingConfig, TrainingData
from spelgen.training.torque_fit import fit_torque

if TYPE_CHECKING:
    from spelgen.training.runs import EmittedModel


def is_closed_form(model: EmittedModel) -> bool:
    """Whether the torque fit knows what to do with this module."""
    return hasattr(model, "inertial_parameters")


def start_from_torque(
    model: EmittedModel, data: TrainingData, config: TrainingConfig, *, fit: bool
) -> tuple[TrainingConfig, list[Diagnostic]]:
    """Fit a closed-form model to the torques of all recordings; the config for what is left to do, and notes.

    Nothing is left unless the objective is ``rollout``. Logs sampled too slowly for accelerations, or larger
    than memory, leave all to the predicted windows. Without ``fit`` the weights stay, as in a run that is resumed.
    Raises RunError where the objective is ``torque`` and the model is made of networks.
    """
    if not is_closed_form(model):
        if config.objective == "torque":
            raise RunError(
                "the objective 'torque' for a model of networks",
                expected="a module of the preset closed-form",
            )
        return config, []
    samples = dynamics_samples(data.recordings)
    if not any(len(x.q) for x in samples):
        message = f"no torque fit: these logs are sampled below {DENSE:g} Hz, or larger than memory"
        return config, [Diagnostic("warning", "no-torque-fit", "logs", None, message)]
    notes = []
    if fit:
        found = fit_torque(model, samples)
        message = (
            f"fitted to the torques of {sum(len(x.q) for x in samples)} samples, those of validation included"
        )
        notes = [Diagnostic("info", "torque-fit", "logs", None, f"{message}, in {found.steps} steps")]
    if config.objective != "rollout":
        config = replace(config, epochs=0, momentum_steps=0)
    return config, notes
