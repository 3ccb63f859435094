"""The stage before windows: the fit to all logs' torques, after which rigid bodies are mostly done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import has_rigid_bodies, has_servos
from spelgen.errors import Diagnostic, LogError
from spelgen.fitting.dataset import TrainingData
from spelgen.fitting.torque_fit import DECIMATION, fit_torque
from spelgen.fitting.torque_networks import adapt_networks, fit_networks
from spelgen.fitting.torque_report import torque_notes
from spelgen.fitting.torque_samples import TorqueSamples
from spelgen.fitting.urdf_regularizer import UrdfRegularizer
from spelgen.identification.samples import DENSE, dynamics_samples
from spelgen.settings.fits import FitConfig, Rollout, TorqueFit, fit_config

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

MOVED = {
    "load": "a load at the tip alone fitted",
    "friction": "friction and torque offsets alone fitted",
    "unit": "what sets this unit apart fitted",
}


def default_objective(model: EmittedModel, rates: Sequence[float]) -> str:
    """What is fitted where nobody says: to an arm under position servos what follows its commands; torque to a
    model of rigid bodies, where logs are sampled densely enough for accelerations (rates [Hz]); else windows.
    """
    if has_servos(model):
        return "servo"
    return "torque" if has_rigid_bodies(model) and any(rate >= DENSE for rate in rates) else "rollout"


def default_config(
    model: EmittedModel,
    rates: Sequence[float],
    options: Mapping[str, Any] | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> FitConfig:
    """The configuration of `default_objective`; options and defaults as for `fit_config`."""
    objective, rigid_bodies = default_objective(model, rates), has_rigid_bodies(model)
    if rigid_bodies and objective == "rollout":  # bodies need no regularizer where nobody asks for one
        defaults = {"urdf_weight": 0.0, **(defaults or {})}
    return fit_config(objective, rigid_bodies=rigid_bodies, options=options, defaults=defaults)


def fit_torque_stage(
    model: EmittedModel,
    data: TrainingData,
    config: FitConfig,
    regularizer: UrdfRegularizer | None = None,
) -> list[Diagnostic]:
    """Fit the model to the torques of all logs, validation included, where its config has that stage; notes.

    Of logs larger than memory the samples lie in a temporary file. Raises LogError where torques are the objective
    and no log is sampled densely enough for accelerations.
    """
    first = isinstance(config, Rollout) and config.torque_first and has_rigid_bodies(model)
    if not isinstance(config, TorqueFit) and not first:
        return []
    samples = _samples(model, data)
    if samples is None:
        if isinstance(config, TorqueFit):
            what = "to adapt to" if config.adapt else "to fit torques to"
            raise LogError(
                f"no motion {what}", expected=f"samples at {DENSE:g} Hz or more that move",
                do="fit windows: the objective rollout",
            )  # fmt: skip
        message = f"no torque fit: these logs are sampled below {DENSE:g} Hz; windows alone are fitted"
        return [Diagnostic("warning", "no-torque-fit", "logs", None, message)]
    steps, notes = _fit(model, samples, config, regularizer)
    what = MOVED[config.adapt] if isinstance(config, TorqueFit) and config.adapt else "fitted"
    message = (
        f"{what} to the torques of {samples.seen} samples, those of validation included, in {steps} steps"
    )
    return [Diagnostic("info", "torque-fit", "logs", None, message), *notes]


def _fit(
    model: EmittedModel, samples: TorqueSamples, config: FitConfig, regularizer: UrdfRegularizer | None
) -> tuple[int, list[Diagnostic]]:
    """Fit the model; the steps it took, and what there is to say."""
    if has_rigid_bodies(model):
        prior, adapt = (config.prior, config.adapt) if isinstance(config, TorqueFit) else (None, None)
        found = fit_torque(model, samples, prior, adapt)
        return found.steps, [] if adapt else [*torque_notes(model, samples, found)]
    assert isinstance(config, TorqueFit)
    if config.adapt:
        return adapt_networks(model, samples, config.adapt, config.weight_decay, config.evaluations), []
    weight = config.urdf_weight
    penalty = lambda: weight * regularizer.loss(model) if regularizer else 0.0  # noqa: E731
    return fit_networks(model, samples, config.weight_decay, penalty, config.evaluations), []


def _samples(model: EmittedModel, data: TrainingData) -> TorqueSamples | None:
    """None: there are none."""
    decimation, reach = DECIMATION if has_rigid_bodies(model) else 1, bristle_reach(model)
    if not data.chunks:
        found = dynamics_samples(data.recordings, preprocessing=data.preprocessing, reach=reach)
        return TorqueSamples.held(found, decimation) if any(len(x.q) for x in found) else None
    each = (
        samples
        for chunk in data.chunks
        for samples in dynamics_samples([chunk.load()], preprocessing=data.preprocessing, reach=reach)
    )
    spooled = TorqueSamples.spooled(each, model.n, reach.elements, decimation)
    return spooled if spooled.count else None
