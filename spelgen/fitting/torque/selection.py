"""What stands beside rigid bodies, selected by cross-validation of the torque that these miss.

A function of one joint is fitted without each tenth of the samples in turn, and without a gap beside it, since errors
of neighbours are alike. It can be selected where the tenths gain, beyond luck, and where the last half of the samples
gains by it, too, after a fit to the first half: one motion often repeats what another does not. If none of a joint
gains so, they are judged between the positions that they were fitted to, since a function is known nowhere else. The
one that gains most is selected; bodies are fitted beside it before others are judged. Networks of several joints are
judged on the last half alone; they are found by L-BFGS from a normal distribution of their weights.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch

from spelgen.dynamics.residuals import residual_torque
from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque.jacobian import ResidualSamples, RigidResponse
from spelgen.fitting.torque.joint_functions import (
    EVERY,
    JointFunction,
    beside,
    deviations,
    fit_function,
    joint_functions,
    most_probable,
)
from spelgen.fitting.torque.tuning import ResidualTuning

TUNING = ResidualTuning()


@dataclass(frozen=True)
class SelectedResidual:
    """A part that was selected. gain: the fraction by which the squares of the torque fell that was missed where it
    acts, in held-out samples.
    """

    name: str
    joint: int | None
    gain: float


def can_be_judged(count: int, correlation: float) -> bool:
    """Return whether of so many samples both halves are more than the gap between them."""
    first, last = halves(count, correlation)
    return bool(last.start - first.stop <= first.stop)


def halves(count: int, correlation: float) -> tuple[slice, slice]:
    """Return the first half of the samples without the gap before the last half, and the last half."""
    middle = count // 2
    return slice(0, max(0, middle - round(TUNING.gap * correlation))), slice(middle, count)


def between_positions(position: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return which positions (T, ...) lie between others (T', ...)."""
    return (position >= others.amin(dim=0)) & (position <= others.amax(dim=0))


def select_functions(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse,
    chosen: Collection[tuple[str, int | None]],
    correlation: float,
) -> list[SelectedResidual]:
    """Return, of each joint, the function beside those chosen by which held-out samples gain most, if any do.

    correlation: samples that err alike.
    """
    noise, joints = deviations(samples.missing), range(samples.q.shape[1])
    candidates: list[list[JointFunction]] = [[] for _ in joints]
    for candidate in joint_functions(model, samples, rigid):
        if (candidate.parameter, candidate.joint) not in chosen:
            candidates[candidate.joint].append(candidate)
    best = (_best(of_joint, samples.missing, noise, correlation) for of_joint in candidates)
    return [residual for residual in best if residual is not None]


def _best(
    candidates: Sequence[JointFunction], missing: torch.Tensor, noise: torch.Tensor, correlation: float
) -> SelectedResidual | None:
    """Return the function that gains most where it was not seen, the first of nearly equal ones; None: none gains."""
    first, last = halves(len(missing), correlation)
    best = best_between = None
    for candidate in candidates:
        target = candidate.target(missing, noise)
        error, between = _held_out_errors(candidate, target, correlation)
        gain = _significant_gain(_by_block(target), _by_block(error))
        gain_between = _significant_gain(_by_block(target * between), _by_block(error * between))
        if gain is None and gain_between is None:
            continue
        weights, _ = fit_function(candidate, target, correlation, first)
        before, after = target[last].square(), (target - candidate.torque(weights))[last].square()
        if gain is not None and after.sum() < before.sum():
            best = _better(best, SelectedResidual(candidate.parameter, candidate.joint, gain))
        between = between_positions(candidate.position[last], candidate.position[first])
        if gain_between is not None and after[between].sum() < before[between].sum():
            gaining = SelectedResidual(candidate.parameter, candidate.joint, gain_between)
            best_between = _better(best_between, gaining)
    # beyond the positions that it was fitted to a spring may be far off, and what is not one usually is
    return best or best_between


def _better(first: SelectedResidual | None, other: SelectedResidual) -> SelectedResidual:
    """Return the one of two that gains more, the first where they are nearly equal."""
    # splines of a straight spring gain nearly what ripple does, and go on as the spring does
    if first is None or 1 - other.gain <= TUNING.clearly_less * (1 - first.gain):
        return other
    return first


def _blocks(count: int) -> list[slice]:
    """Return as many blocks of these samples as there are folds."""
    edges = torch.linspace(0, count, TUNING.folds + 1).long().tolist()
    return [slice(start, stop) for start, stop in pairwise(edges)]


def _held_out_errors(
    candidate: JointFunction, target: torch.Tensor, correlation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what is missed (T,) of each block after a fit to the others, and which samples lie between positions of
    these.
    """
    rows, gap = beside(candidate.features, target), round(TUNING.gap * correlation)
    everything = rows.mT @ rows
    errors, between, position = [], [], candidate.position
    for block in _blocks(len(target)):
        near = slice(max(0, block.start - gap), block.stop + gap)
        others = torch.cat([position[: near.start], position[near.stop :]])
        sums = everything - rows[near].mT @ rows[near]
        weights, _ = most_probable(sums, len(others), candidate.groups, correlation)
        errors.append(target[block] - candidate.torque(weights, block))
        between.append(between_positions(position[block], others))
    return torch.cat(errors), torch.cat(between)


def _by_block(values: torch.Tensor) -> torch.Tensor:
    """Return the sums of the values' squares (T, ...) over blocks of samples (folds,)."""
    squares = [values[block].square().sum() for block in _blocks(len(values))]
    return torch.stack(squares)


def _significant_gain(squares: torch.Tensor, missed: torch.Tensor) -> float | None:
    """Return the fraction by which sums of squares of blocks fell; None where luck could do that, or it is next to
    nothing.
    """
    # between -1 and 1: neither a block of large torques, nor one where joints go farther than in all others, makes all
    # others luck; one next to nothing counts as nothing
    negligible = 2 * TUNING.least_gain * squares.mean()
    gains = (squares - missed) / (squares + missed + negligible)
    error = gains.std() / len(gains) ** 0.5
    if not gains.isfinite().all() or gains.mean() <= TUNING.standard_errors * error:
        return None
    mean = float(gains.mean())
    fraction = 2 * mean / (1 + mean)  # as if all blocks gained alike
    return fraction if fraction > TUNING.least_gain else None


def select_networks(model: Any, samples: ResidualSamples, correlation: float) -> Iterator[SelectedResidual]:
    """Select the potential's network, then that of the mass matrix."""
    step = -(-len(samples.q) // TUNING.network_samples)
    subset = ResidualSamples(*(column[::step] for column in samples))
    # what all residuals together are to give: functions of joints are there already
    with torch.no_grad():
        present = residual_torque(model, *subset[:3])
    subset = subset._replace(missing=subset.missing + present)
    terms = model.residuals
    networks = {"residual_potential": list(terms.potential.parameters()) if terms.potential else []}
    networks["residual_mass"] = [terms.raw_constants, *(terms.mass.parameters() if terms.mass else ())]
    for name, weights in networks.items():
        gain = None
        if weights:
            network = torch.nn.ParameterList(weights)
            gain = _fit_network(model, network, subset, max(1.0, correlation / step))
        if gain is not None:
            yield SelectedResidual(name, None, gain)


def _fit_network(
    model: Any, network: torch.nn.Module, samples: ResidualSamples, correlation: float
) -> float | None:
    """Fit one network where that pays on the last half of the samples after a fit to the first; return the gain there.

    Else it is left as it is. samples: as missing, what all residuals together are to give.
    """
    start, missing = copy.deepcopy(network.state_dict()), _still_missing(model, samples)
    noise = deviations(missing)

    def fit(rows: slice, evaluations: int) -> None:
        chosen = ResidualSamples(*(column[rows] for column in samples))

        def cost() -> torch.Tensor:
            error = chosen.missing - residual_torque(model, *chosen[:3])
            return 0.5 * (error / noise).square().sum() / correlation

        network.load_state_dict(start)
        minimise(network, lambda: [cost()], evaluations, weight_decay=1.0)

    first, last = halves(len(samples.q), correlation)
    # most networks explain nothing, which few evaluations show
    for evaluations in (TUNING.network_first_look, TUNING.network_evaluations):
        fit(first, evaluations)
        error = _still_missing(model, samples)
        squares, missed = _by_block((missing / noise)[last]), _by_block((error / noise)[last])
        gain = _significant_gain(squares, missed)
        if missed.sum() >= squares.sum():
            break
    network.load_state_dict(start)
    if gain is not None:
        fit(EVERY, TUNING.network_evaluations)
    model.zero_grad(set_to_none=True)
    return gain


def _still_missing(model: Any, samples: ResidualSamples) -> torch.Tensor:
    """Return what all that stands beside rigid bodies leaves of the torque that it is to give, (T, n)."""
    with torch.no_grad():
        return samples.missing - residual_torque(model, *samples[:3])
