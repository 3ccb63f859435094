"""Selection of single-joint residual terms by cross-validation of the torque residual.

Several recordings are held out one at a time, or in groups if there are more than ten. A single recording is divided
into ten contiguous blocks, which are held out one at a time, with a gap on both sides, since successive errors are
correlated. Every sample is held out once and then has a held-out error. A candidate must pass three tests:

- The relative reduction of the held-out squared error is significant (one-sided t test over ten contiguous blocks of
  all samples, 1 %, or 0.1 % for one or two recordings).
- Fitted to the first half of the samples, the candidate also lowers the error on the last half: errors often repeat
  within one motion, and differ between motions.
- With one or two recordings, the torque of the candidate is plausible (`max_torques`).

If no candidate of a joint passes, the tests are repeated without the samples whose positions are outside the range of
the fitted samples, since splines do not extrapolate. Of the accepted candidates of a joint, the one with the largest
error reduction is selected.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque.jacobian import ResidualSamples
from spelgen.fitting.torque.joint_functions import (
    FRICTION,
    RIPPLE,
    TORQUE,
    JointFunction,
    TermKey,
    joint_functions,
    rms_per_joint,
)
from spelgen.fitting.torque.linearization import RigidProjection
from spelgen.fitting.torque.tuning import SELECTION


@dataclass(frozen=True)
class SelectedTerm:
    """A selected residual term.

    Attributes:
        name: name of the parameter of the term, or `residual_potential` or `residual_mass`.
        joint: index of the joint; None for networks.
        error_reduction: relative reduction of the held-out squared torque residual at the joints on which the term
            acts.
    """

    name: str
    joint: int | None
    error_reduction: float


def can_split(count: int, correlation_length: float) -> bool:
    """Return True if `count` samples suffice for `split_halves`, that is, if the fitted slice is not too short.

    The end of the first half is omitted, as a gap between the fitted slice and the last half. The gap must be at most
    as long as the fitted slice. correlation_length: number of samples per independent error.
    """
    first, last = split_halves(count, correlation_length)
    return bool(last.start - first.stop <= first.stop)


def split_halves(count: int, correlation_length: float) -> tuple[slice, slice]:
    """Return two slices of `count` samples: the first half without its end, to be fitted, and the last half, held out.

    The omitted end is a gap of `SELECTION.gap` correlation lengths, so that the errors of both slices are independent.
    correlation_length: number of samples per independent error.
    """
    middle = count // 2
    return slice(0, max(0, middle - _gap(correlation_length))), slice(middle, count)


def _gap(correlation_length: float) -> int:
    """Return the number of omitted samples between fitted and held-out samples: `SELECTION.gap` correlation lengths.

    correlation_length: number of samples per independent error.
    """
    return round(SELECTION.gap * correlation_length)


def within_range(position: torch.Tensor, fitted: torch.Tensor) -> torch.Tensor:
    """Return a mask (T, ...): True for positions (T, ...) between the minimum and the maximum of the fitted positions.

    fitted: T' positions, (T', ...) [rad, m].
    """
    return (position >= fitted.amin(dim=0)) & (position <= fitted.amax(dim=0))


def select_functions(
    model: ArmModel,
    samples: ResidualSamples,
    projection: RigidProjection,
    selected: Collection[TermKey],
    correlation_length: torch.Tensor,
    recordings: torch.Tensor,
    torque_std: torch.Tensor,
) -> list[SelectedTerm]:
    """Select single-joint residual terms by cross-validation: at most one per joint, the best accepted candidate.

    Args:
        model: model with residual terms.
        samples: samples with the torque residual of the model with its current residual terms.
        projection: projection onto the rigid-body and friction model.
        selected: (parameter, joint) of the terms that were selected before; they are no candidates.
        correlation_length: (n,) number of samples per independent error.
        recordings: (T,) index of the recording of each sample.
        torque_std: (n,) standard deviation of the torque [Nm, N].
    """
    noise, joints = rms_per_joint(samples.torque_residual), range(samples.q.shape[1])
    candidates: list[list[JointFunction]] = [[] for _ in joints]
    for candidate in joint_functions(model, samples, projection):
        if (candidate.parameter, candidate.joint) not in selected:
            candidates[candidate.joint].append(candidate)
    # Cross-validation holds out complete recordings. With two recordings there are only two fits, one per recording,
    # and the ten blocks of the t test have correlated errors. The tests of candidates are therefore as strict as for a
    # single recording: `standard_errors_of_one` is the limit of the t test, and `max_torques` limits the torque.
    limits = None if int(recordings.max()) > 1 else max_torques(model, samples.q, torque_std)
    best = (
        _best(of_joint, samples.torque_residual, noise, float(length), recordings, limits)
        for of_joint, length in zip(candidates, correlation_length, strict=True)
    )
    return [term for term in best if term is not None]


def max_torques(model: ArmModel, q: torch.Tensor, torque_std: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the largest allowed standard deviation of the torque of residual terms, {parameter: (n,) [Nm, N]}.

    The bounds apply to terms that are selected on one or two recordings: a fraction of torque_std for ripple and torque
    splines, and infinity for friction factors. For splines the bound is zero at joints without gravity load: the
    splines represent springs, which are built in to balance a load.

    Args:
        model: fitted model.
        q: (T, n) positions [rad, m].
        torque_std: (n,) standard deviation of the joint torques in the logs [Nm, N].
    """
    with torch.no_grad():
        loaded = model.gravity(q).std(dim=0) > SELECTION.min_load_fraction * torque_std
    limit = SELECTION.max_torque_fraction * torque_std
    return {RIPPLE: limit, TORQUE: limit * loaded, FRICTION: torch.full_like(limit, torch.inf)}


def _best(
    candidates: Sequence[JointFunction],
    torque_residual: torch.Tensor,
    noise: torch.Tensor,
    correlation_length: float,
    recordings: torch.Tensor,
    limits: dict[str, torch.Tensor] | None,
) -> SelectedTerm | None:
    """Return the accepted candidate with the largest error reduction; None if no candidate is accepted.

    Args:
        candidates: residual terms of one joint.
        torque_residual: (T, n) [Nm, N].
        noise: (n,) standard deviations of the torque noise [Nm, N].
        correlation_length: number of samples per independent error.
        recordings: (T,), index of the recording of each sample.
        limits: {parameter of a residual term: largest allowed standard deviation of its torque, (n,) [Nm, N]} (see
            `max_torques`) for one or two recordings, in which a model error may repeat with the motion; None: no
            bounds.
    """
    significance = SELECTION.standard_errors if limits is None else SELECTION.standard_errors_of_one
    # In the second test, a candidate is fitted to the first half, and its error is computed on the last half: fitted
    # and held-out samples have a larger distance in time than in the folds of the first test.
    first, last = split_halves(len(torque_residual), correlation_length)
    best: list[SelectedTerm | None] = [None, None]
    for candidate in candidates:
        target = candidate.target(torque_residual, noise)
        error, covered = _cross_validate(candidate, target, correlation_length, recordings)
        everywhere = torch.ones_like(covered)
        reductions = [
            significant_reduction(block_squares(target * rows), block_squares(error * rows), significance)
            for rows in (everywhere, covered)
        ]
        if reductions == [None, None]:
            continue
        torque = candidate.torque(candidate.fit(target, correlation_length, first).coef)
        before, after = target[last].square(), (target - torque)[last].square()
        # A candidate whose torque is implausibly large is rejected: it probably fits a model error that repeats with
        # the motion, and not an effect in the joint, such as a spring.
        limit = torch.inf if limits is None else float(limits[candidate.parameter][candidate.joint])
        inside = within_range(candidate.position, candidate.position[first])
        for index, rows in enumerate((everywhere, inside)):
            reduction, lower = reductions[index], after[rows[last]].sum() < before[rows[last]].sum()
            if reduction is not None and lower and torque[rows].std() <= limit:
                best[index] = _better(
                    best[index], SelectedTerm(candidate.parameter, candidate.joint, reduction)
                )
    # `best` has two elements: the best candidate in tests on all held-out samples, and in tests on held-out samples
    # within the fitted range of positions. The first is preferred, since it also predicts the torque outside this
    # range.
    return best[0] or best[1]


def _better(first: SelectedTerm | None, other: SelectedTerm) -> SelectedTerm:
    """Return the better one of two candidates of a joint; `first` is preferred at similar errors.

    The result is `other` if there is no `first`, or if the held-out error of `other` is clearly smaller
    (`preference_ratio`).
    """
    # Candidates are tested in the order splines, friction factor, ripple. At similar errors splines are preferred to
    # ripple: both fit the torque of a linear spring, but only splines extrapolate it.
    if first is None or 1 - other.error_reduction <= SELECTION.preference_ratio * (1 - first.error_reduction):
        return other
    return first


def _blocks(count: int) -> list[slice]:
    """Return the slices that divide `count` samples into contiguous blocks, one block per fold."""
    edges = torch.linspace(0, count, SELECTION.folds + 1).long().tolist()
    return [slice(start, stop) for start, stop in pairwise(edges)]


def _folds(recordings: torch.Tensor, gap: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yield two masks (T,) per fold: the held-out samples, and the fitted samples.

    If there are several recordings, each fold holds out one or more complete recordings. A single recording is divided
    into blocks, each held out once; the `gap` samples before and after a held-out block are in neither mask.
    recordings: (T,), index of the recording of each sample.
    """
    # Whole recordings are held out if possible: they differ in day, load and motion, so their errors differ more than
    # the errors of blocks of one recording.
    number = int(recordings.max()) + 1
    if number == 1:
        rows = torch.arange(len(recordings))
        for block in _blocks(len(recordings)):
            held_out = (rows >= block.start) & (rows < block.stop)
            yield held_out, (rows < block.start - gap) | (rows >= block.stop + gap)
        return
    folds = min(number, SELECTION.folds)
    for fold in range(folds):
        held_out = recordings * folds // number == fold
        yield held_out, ~held_out


def _cross_validate(
    candidate: JointFunction, target: torch.Tensor, correlation_length: float, recordings: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cross-validation error (T,) [Nm, N], and a mask (T,) of the samples without extrapolation.

    The candidate is fitted to ``target``, (T,) [Nm, N]; for the other arguments see `_best`. The error at a sample is
    the error of the fit to the other folds. The mask is True if the position of the sample is within the range of
    positions of this fit.
    """
    position = candidate.position
    error, within = torch.zeros_like(target), torch.zeros_like(target, dtype=torch.bool)
    for held_out, fitted in _folds(recordings, _gap(correlation_length)):
        fit = candidate.fit(target, correlation_length, fitted)
        error[held_out] = target[held_out] - candidate.torque(fit.coef, held_out)
        within[held_out] = within_range(position[held_out], position[fitted])
    return error, within


def block_squares(values: torch.Tensor) -> torch.Tensor:
    """Return the sum of squares of each block, (folds,), for values (T, ...) divided into blocks by `_blocks`."""
    squares = [values[block].square().sum() for block in _blocks(len(values))]
    return torch.stack(squares)


def significant_reduction(
    before: torch.Tensor, after: torch.Tensor, standard_errors: float = SELECTION.standard_errors
) -> float | None:
    """Return the relative reduction of squared errors by a residual term, or None if it is not significant.

    A t test is applied to g = (before - after) / (before + after) of all blocks. g is between -1 and 1, so that no
    single block dominates the variance, for example one with large torques or with extrapolation. A negligible number
    is added to the denominator, so that g is zero for blocks without torque.

    Args:
        before: sum of squared errors of each block without the term, (folds,).
        after: sum of squared errors of each block with the term, (folds,).
        standard_errors: value of t that the mean of g over the blocks must exceed.
    """
    negligible = 2 * SELECTION.min_reduction * before.mean()
    # g = (before - after) / (before + after) is used because it is symmetric: if a term halves the squared error of one
    # block and doubles the squared error of another, their values of g add up to zero.
    g = (before - after) / (before + after + negligible)
    standard_error = g.std() / len(g) ** 0.5
    if not g.isfinite().all() or g.mean() <= standard_errors * standard_error:
        return None
    mean = float(g.mean())
    # From g = (before - after) / (before + after) follows (before - after) / before = 2 g / (1 + g).
    reduction = 2 * mean / (1 + mean)
    return reduction if reduction > SELECTION.min_reduction else None
