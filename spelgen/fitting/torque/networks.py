"""Fits of networks to torques by L-BFGS: models that consist of networks, and residual terms that are networks."""

import copy
from collections.abc import Callable, Iterator

import torch

from spelgen.dynamics.parameters import residual_torque
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque.jacobian import ResidualSamples
from spelgen.fitting.torque.joint_functions import ALL, rms_per_joint
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.selection import SelectedTerm, block_squares, significant_reduction, split_halves
from spelgen.fitting.torque.tuning import SELECTION
from spelgen.settings.fits import DEFAULTS, Adaptation

ADAPTED_PARTS: dict[Adaptation, tuple[str, ...]] = {
    "load": ("mass.", "potential."),
    "friction": ("friction.",),
    "unit": ("",),
}
"""Prefixes of the names of the weights that a fit with the option `adapt` changes, per value of the option."""
# Number of samples per block of the loss; its gradient needs all intermediate results of a block in memory.
BLOCK = 2**16


def fit_networks(
    model: ArmModel,
    samples: TorqueSamples,
    weight_decay: float,
    penalty: Callable[[], torch.Tensor | float] | None = None,
    evaluations: int = 2000,
) -> int:
    """Minimize the mean squared torque error of a model over its weights; return the number of evaluations.

    Args:
        model: model; only its weights that require a gradient are fitted.
        samples: samples with torques as logged, (T, n) [Nm, N]; errors are divided by the standard deviation of each
            joint's torque.
        weight_decay: factor of half the sum of squares of all weight matrices, which is added to the loss.
        penalty: function that returns a term added to the loss, for example the distance from a URDF.
        evaluations: maximum number of evaluations of the loss.
    """
    count, joints = samples.columns.tau.shape
    scale = samples.columns.tau.std(dim=0)
    # The standard deviation of the torque has a lower bound: otherwise the errors of a joint of constant torque would
    # have an infinite weight.
    scale = torch.maximum(scale, 1e-2 * scale.amax())

    def summands() -> Iterator[torch.Tensor]:
        for number, (q, qd, qdd, tau, *_) in enumerate(samples.blocks(BLOCK)):
            error = ((model.inverse_dynamics(q, qd, qdd) - tau) / scale).square()
            cost = error.mean() if count <= BLOCK else error.sum() / (count * joints)
            # The loss is a sum over blocks, so the penalty is added to the first block only.
            if number == 0 and penalty is not None:
                cost = cost + penalty()
            yield cost

    return minimise(model, summands, evaluations, weight_decay)


def adapt_networks(
    model: ArmModel,
    samples: TorqueSamples,
    adapt: Adaptation,
    weight_decay: float = DEFAULTS.lbfgs_decay,
    evaluations: int = 2000,
) -> int:
    """Fit a part of a fitted model to further samples; return the number of evaluations.

    Args:
        model: fitted model.
        samples: samples with torques as logged, (T, n) [Nm, N].
        adapt: name of the adapted part of the model, see `ADAPTED_PARTS`.
        weight_decay: factor of half the squared change of the weights, which is added to the loss. Weights that the
            samples do not determine therefore remain unchanged.
        evaluations: maximum number of evaluations of the loss.
    """
    fitted = {name: x for name, x in model.named_parameters() if name.startswith(ADAPTED_PARTS[adapt])}
    initial = {name: x.detach().clone() for name, x in fitted.items()}

    def penalty() -> torch.Tensor | float:
        return weight_decay / 2 * sum((x - initial[name]).square().sum() for name, x in fitted.items())

    try:
        for name, parameter in model.named_parameters():
            parameter.requires_grad_(name in fitted)
        return fit_networks(model, samples, 0.0, penalty, evaluations)
    finally:
        model.requires_grad_(True)


def select_networks(
    model: ArmModel, samples: ResidualSamples, correlation_length: float
) -> Iterator[SelectedTerm]:
    """Fit the network of the potential, then the network of the mass matrix; yield the networks that are accepted.

    A network is accepted if it significantly lowers the error on held-out samples (see `_fit_network`).

    Args:
        model: model with residual terms; weights of accepted networks are written to it.
        samples: samples with the torque residual of the model, whose current residual terms are included.
        correlation_length: number of samples per independent error.
    """
    # The time of L-BFGS is proportional to the number of samples, and successive samples are correlated, so that a
    # subset suffices.
    step = -(-len(samples.q) // SELECTION.network_samples)
    subset = ResidualSamples(*(column[::step] for column in samples))
    # The target is the torque for all residual terms together: the torque residual of the model plus the torque of its
    # current residual terms.
    with torch.no_grad():
        current = residual_torque(model, *subset[:3])
    subset = subset._replace(torque_residual=subset.torque_residual + current)
    # The network of the potential is fitted first, since it does not depend on accelerations, which are the noisiest
    # signals.
    terms = model.residuals
    networks = {"residual_potential": list(terms.potential.parameters()) if terms.potential else []}
    networks["residual_mass"] = [terms.raw_constants, *(terms.mass.parameters() if terms.mass else ())]
    for name, weights in networks.items():
        reduction = None
        if weights:
            network = torch.nn.ParameterList(weights)
            reduction = _fit_network(model, network, subset, max(1.0, correlation_length / step))
        if reduction is not None:
            yield SelectedTerm(name, None, reduction)


def _fit_network(
    model: ArmModel, network: torch.nn.Module, samples: ResidualSamples, correlation_length: float
) -> float | None:
    """Fit a network; return the relative reduction of the squared held-out error, None if the network is rejected.

    The network is fitted to the first half of the samples, and accepted if it significantly lowers the error on the
    last half. An accepted network is refitted to all samples; a rejected one has its initial weights. The other
    residual terms of the model are fixed; their torque is subtracted from the torque residual of the samples.

    samples: samples with the torque residual of the model without residual terms. correlation_length: number of samples
    per independent error.
    """
    initial, residual = copy.deepcopy(network.state_dict()), _remaining_residual(model, samples)
    noise = rms_per_joint(residual)

    def fit(rows: slice, evaluations: int) -> None:
        selected = ResidualSamples(*(column[rows] for column in samples))

        def cost() -> torch.Tensor:
            error = selected.torque_residual - residual_torque(model, *selected[:3])
            return 0.5 * (error / noise).square().sum() / correlation_length

        network.load_state_dict(initial)
        minimise(network, lambda: [cost()], evaluations, weight_decay=1.0)

    first, last = split_halves(len(samples.q), correlation_length)
    # Most networks explain nothing, which a few evaluations of the loss show: they are rejected without a full fit.
    for evaluations in (SELECTION.network_probe_evaluations, SELECTION.network_evaluations):
        fit(first, evaluations)
        error = _remaining_residual(model, samples)
        before, after = block_squares((residual / noise)[last]), block_squares((error / noise)[last])
        reduction = significant_reduction(before, after)
        if after.sum() >= before.sum():
            break
    network.load_state_dict(initial)
    # An accepted network is refitted to all samples.
    if reduction is not None:
        fit(ALL, SELECTION.network_evaluations)
    model.zero_grad(set_to_none=True)
    return reduction


def _remaining_residual(model: ArmModel, samples: ResidualSamples) -> torch.Tensor:
    """Return the torque residual of `samples` minus the torque of the model's residual terms, (T, n) [Nm, N].

    samples: samples with the torque residual of the model without residual terms.
    """
    with torch.no_grad():
        return samples.torque_residual - residual_torque(model, *samples[:3])
