"""Selection of single-joint residual terms by cross-validation of the torque residual.

Each candidate is fitted with 10-fold cross-validation over contiguous blocks, with a gap on both sides of the held-out
block, since successive errors are correlated. It is accepted if its mean relative error reduction over the blocks is
significant (one-sided t test, 1 %), and if, fitted to the first half, it also lowers the error on the last half: often
one motion repeats errors that another motion does not have. If no candidate of a joint is accepted, both tests are
repeated with the held-out samples at positions within the range of the fitted samples, since splines do not
extrapolate. Of the accepted candidates of a joint the one with the largest error reduction is selected.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque.jacobian import ResidualSamples
from spelgen.fitting.torque.joint_functions import JointFunction, TermKey, joint_functions, rms_per_joint
from spelgen.fitting.torque.linearization import RigidProjection, append_target, bayesian_ridge
from spelgen.fitting.torque.tuning import SELECTION


@dataclass(frozen=True)
class SelectedTerm:
    """A selected residual term.

    name: of its parameter, or `residual_potential` or `residual_mass`. joint: None for networks. error_reduction:
    relative reduction of the held-out squared torque residual at the joints that the term acts on.
    """

    name: str
    joint: int | None
    error_reduction: float


def can_split(count: int, correlation_length: float) -> bool:
    """Return whether the halves of `count` samples are longer than the gap between them."""
    first, last = split_halves(count, correlation_length)
    return bool(last.start - first.stop <= first.stop)


def split_halves(count: int, correlation_length: float) -> tuple[slice, slice]:
    """Return the first half of the samples, without a gap before the last half, and the last half."""
    middle = count // 2
    return slice(0, max(0, middle - _gap(correlation_length))), slice(middle, count)


def _gap(correlation_length: float) -> int:
    """Return the number of samples between fitted and held-out samples."""
    return round(SELECTION.gap * correlation_length)


def within_range(position: torch.Tensor, fitted: torch.Tensor) -> torch.Tensor:
    """Return a mask of the positions (T, ...) within the range of fitted positions (T', ...)."""
    return (position >= fitted.amin(dim=0)) & (position <= fitted.amax(dim=0))


def select_functions(
    model: ArmModel,
    samples: ResidualSamples,
    projection: RigidProjection,
    selected: Collection[TermKey],
    correlation_length: torch.Tensor,
) -> list[SelectedTerm]:
    """Return the term selected per joint, for joints with an accepted candidate.

    Args:
        model: model with residual terms.
        samples: torque residual of the model with its current terms.
        projection: of the rigid-body and friction model.
        selected: terms that the model has already.
        correlation_length: (n,) number of samples per independent error.
    """
    noise, joints = rms_per_joint(samples.torque_residual), range(samples.q.shape[1])
    candidates: list[list[JointFunction]] = [[] for _ in joints]
    for candidate in joint_functions(model, samples, projection):
        if (candidate.parameter, candidate.joint) not in selected:
            candidates[candidate.joint].append(candidate)
    best = (
        _best(of_joint, samples.torque_residual, noise, float(length))
        for of_joint, length in zip(candidates, correlation_length, strict=True)
    )
    return [term for term in best if term is not None]


def _best(
    candidates: Sequence[JointFunction],
    torque_residual: torch.Tensor,
    noise: torch.Tensor,
    correlation_length: float,
) -> SelectedTerm | None:
    """Return the accepted candidate of one joint with the largest error reduction, or None.

    torque_residual: (T, n). noise: (n,).
    """
    first, last = split_halves(len(torque_residual), correlation_length)
    best = best_within = None
    for candidate in candidates:
        target = candidate.target(torque_residual, noise)
        error, within = _cross_validate(candidate, target, correlation_length)
        reduction = significant_reduction(block_squares(target), block_squares(error))
        reduction_within = significant_reduction(
            block_squares(target * within), block_squares(error * within)
        )
        if reduction is None and reduction_within is None:
            continue
        weights = candidate.fit(target, correlation_length, first).coef
        before, after = target[last].square(), (target - candidate.torque(weights))[last].square()
        if reduction is not None and after.sum() < before.sum():
            best = _better(best, SelectedTerm(candidate.parameter, candidate.joint, reduction))
        within = within_range(candidate.position[last], candidate.position[first])
        if reduction_within is not None and after[within].sum() < before[within].sum():
            accepted = SelectedTerm(candidate.parameter, candidate.joint, reduction_within)
            best_within = _better(best_within, accepted)
    # a candidate that extrapolates is preferred: outside the fitted range a spring has errors, and other functions of
    # position have larger ones
    return best or best_within


def _better(first: SelectedTerm | None, other: SelectedTerm) -> SelectedTerm:
    """Return the other term if its error is clearly smaller, else the first."""
    # splines of a linear spring reduce the error nearly as much as ripple does, and they extrapolate
    if first is None or 1 - other.error_reduction <= SELECTION.preference_ratio * (1 - first.error_reduction):
        return other
    return first


def _blocks(count: int) -> list[slice]:
    """Return contiguous blocks of `count` samples, one per fold."""
    edges = torch.linspace(0, count, SELECTION.folds + 1).long().tolist()
    return [slice(start, stop) for start, stop in pairwise(edges)]


def _cross_validate(
    candidate: JointFunction, target: torch.Tensor, correlation_length: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the held-out error (T,) of all blocks, each after a fit to the others, and a mask (T,) of the held-out
    positions within the range of the fitted ones.
    """
    rows, gap = append_target(candidate.features, target), _gap(correlation_length)
    all_products = rows.mT @ rows
    errors, within, position = [], [], candidate.position
    for block in _blocks(len(target)):
        excluded = slice(max(0, block.start - gap), block.stop + gap)
        fitted = torch.cat([position[: excluded.start], position[excluded.stop :]])
        products = all_products - rows[excluded].mT @ rows[excluded]
        fit = bayesian_ridge(products, len(fitted), candidate.groups, correlation_length)
        errors.append(target[block] - candidate.torque(fit.coef, block))
        within.append(within_range(position[block], fitted))
    return torch.cat(errors), torch.cat(within)


def block_squares(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares of values (T, ...) per block, (folds,)."""
    squares = [values[block].square().sum() for block in _blocks(len(values))]
    return torch.stack(squares)


def significant_reduction(before: torch.Tensor, after: torch.Tensor) -> float | None:
    """Return the relative reduction of sums of squares per block (folds,), or None if it is not significant.

    The t test is on g = (before - after) / (before + after) per block, which is between -1 and 1: neither a block of
    large torques nor a block of extrapolation dominates the variance. A negligible part of the mean square is added to
    the denominator, so that blocks without torque count as zero.
    """
    negligible = 2 * SELECTION.min_reduction * before.mean()
    g = (before - after) / (before + after + negligible)
    standard_error = g.std() / len(g) ** 0.5
    if not g.isfinite().all() or g.mean() <= SELECTION.standard_errors * standard_error:
        return None
    mean = float(g.mean())
    reduction = 2 * mean / (1 + mean)  # g = (b - a) / (b + a) solved for (b - a) / b, at the mean g
    return reduction if reduction > SELECTION.min_reduction else None
