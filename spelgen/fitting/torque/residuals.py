"""What stands beside rigid bodies, fitted to the torque that they miss: selected by cross-validation.

Bodies and friction laws were fitted alone, and have taken over what they can of a spring. A torque by position is
therefore compared as far as they cannot: a partial regression (Frisch and Waugh, Econometrica 1:387, 1933).

A function of one joint is fitted without each tenth of the samples in turn, and without a gap beside it, since errors
of neighbours are alike. It can be selected where the tenths gain, beyond luck, and where the last half of the samples
gains by it, too, after a fit of it and of those before it to the first half: one motion often repeats what another does
not. If none gains so, they are judged between the positions that they were fitted to, since a function is known nowhere
else. The function that gains most comes first. Networks of several joints are judged on the last half alone.

Functions are linear in their weights, which are found with their scale by maximising the marginal likelihood (MacKay,
Neural Computation 4:415, 1992); networks are found by L-BFGS from a normal distribution of their weights.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.residuals import residual_torque
from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque.jacobian import ResidualSamples, RigidResponse
from spelgen.runtime.residual_terms import LARGEST, SPLINES
from spelgen.settings.tuning.fitting import ResidualTuning

TUNING = ResidualTuning()

EVERY = slice(None)
FRICTION = "raw_friction_splines"
WIDEST = 0.99 * LARGEST  # weights of friction's logarithm: beyond, the model's own are infinite


@dataclass(frozen=True)
class SelectedResidual:
    """A part that was selected. gain: the fraction by which the squares of the torque fell that was missed where it
    acts, in held-out samples.
    """

    name: str
    joint: int | None
    gain: float


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A function of one joint.

    The model's parameter of that name has a row (W,) for it, in units of ``scale``. Weights are those of ``lines``,
    (W, L), which are sums over the row, and then the row's own: P = L + W.
    position: (T,) of the joint.
    features: (T, P); in a selection, of torques what bodies and laws cannot take over.
    force: (n,) how its torque acts on the joints.
    groups: (P,) which weights have a scale in common.
    friction: (T,) what the function varies, with weights of its logarithm, to which features are the linear answer.
    """

    parameter: str
    joint: int
    scale: float
    position: torch.Tensor
    features: torch.Tensor
    force: torch.Tensor
    lines: torch.Tensor
    groups: torch.Tensor
    friction: torch.Tensor | None

    def weights(self, functions: Any) -> torch.Tensor:
        """Return weights (P,) that give the model's."""
        if self.friction is not None:
            row = functions.friction_logarithms()[self.joint]
        else:
            row = functions.get_parameter(self.parameter)[self.joint] * self.scale
        return F.pad(row.detach(), (self.lines.shape[1], 0))

    def write(self, functions: Any, weights: torch.Tensor) -> None:
        """Make them the model's."""
        count = self.lines.shape[1]
        weights = self.lines @ weights[:count] + weights[count:]
        if self.friction is not None:
            weights = LARGEST * (weights.clamp(-WIDEST, WIDEST) / LARGEST).atanh()
        with torch.no_grad():
            functions.get_parameter(self.parameter)[self.joint] = weights / self.scale

    def torque(self, weights: torch.Tensor, rows: slice = EVERY) -> torch.Tensor:
        """Return what they add to these samples (T,)."""
        features = self.features[rows]
        if self.friction is None:
            return features @ weights
        friction = self.friction[rows]
        logarithm = (features @ weights.clamp(-WIDEST, WIDEST)) / friction
        return friction * logarithm.nan_to_num().expm1()

    def target(self, missing: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Return what of the missing torque (T, n) the function could be (T,)."""
        weight = self.force / noise.square()
        return (missing @ weight) / (self.force @ weight)


def select_residuals(
    model: Any, samples: ResidualSamples, rigid: RigidResponse, correlation: float
) -> list[SelectedResidual]:
    """Give the model all parts that held-out samples gain by; return these. correlation: samples that err alike."""
    first, last = _halves(len(samples.q), correlation)
    if first.stop < last.start - first.stop:  # the gap leaves next to nothing of so few samples
        return []
    noise, selected = _noise(samples.missing), []
    missing = missing_early = samples.missing  # the latter by the same parts, fitted to the first half
    candidates = list(_candidates(model, samples, rigid))
    while best := _best(candidates, missing, missing_early, noise, correlation):
        candidate, gain, torque_early = best
        weights = _fit_candidate(candidate, candidate.target(missing, noise), correlation)
        candidate.write(model.residuals, weights)
        missing = missing - candidate.torque(weights).unsqueeze(-1) * candidate.force
        missing_early = missing_early - torque_early.unsqueeze(-1) * candidate.force
        candidates.remove(candidate)
        selected.append(SelectedResidual(candidate.parameter, candidate.joint, gain))
    return [*selected, *_select_networks(model, samples._replace(missing=missing), correlation)]


def refit_residuals(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse | None,
    selected: Sequence[SelectedResidual],
    correlation: float,
) -> None:
    """Fit the selected functions of single joints anew, beside what else has changed since.

    To all that is missed where ``rigid`` is None, else as far as bodies and laws cannot follow.
    """
    noise, missing, functions = _noise(samples.missing), samples.missing, model.residuals
    chosen = {(residual.name, residual.joint) for residual in selected}
    for candidate in _candidates(model, samples, rigid, chosen):
        present = (candidate.features @ candidate.weights(functions)).unsqueeze(-1) * candidate.force
        target = candidate.target(missing + present, noise)
        weights = _fit_candidate(candidate, target, correlation)
        candidate.write(functions, weights)
        changed = (candidate.features @ weights).unsqueeze(-1) * candidate.force
        missing = missing + present - changed


class _Gaining(NamedTuple):
    """A candidate that gains where it was not seen. torque_early: (T,) after a fit to the first half."""

    candidate: _Candidate
    gain: float
    torque_early: torch.Tensor


def _best(
    candidates: Sequence[_Candidate],
    missing: torch.Tensor,
    missing_early: torch.Tensor,
    noise: torch.Tensor,
    correlation: float,
) -> _Gaining | None:
    """Return the candidate that gains most where it was not seen, the first of nearly equal ones; None: none gains.

    missing_early: (T, n) after fits to the first half.
    """
    first, last = _halves(len(missing), correlation)
    best = best_between = None
    for candidate in candidates:
        target, target_early = candidate.target(missing, noise), candidate.target(missing_early, noise)
        error, between = _held_out_errors(candidate, target, correlation)
        gain = _significant_gain(_by_block(target), _by_block(error))
        gain_between = _significant_gain(_by_block(target * between), _by_block(error * between))
        if gain is None and gain_between is None:
            continue
        torque_early = candidate.torque(_fit_candidate(candidate, target_early, correlation, first))
        before, after = target_early[last].square(), (target_early - torque_early)[last].square()
        if gain is not None and after.sum() < before.sum():
            best = _better(best, _Gaining(candidate, gain, torque_early))
        between = _between(candidate.position[last], candidate.position[first])
        if gain_between is not None and after[between].sum() < before[between].sum():
            best_between = _better(best_between, _Gaining(candidate, gain_between, torque_early))
    # beyond the positions that it was fitted to a spring may be far off, and what is not one usually is
    return best or best_between


def _better(first: _Gaining | None, other: _Gaining) -> _Gaining:
    """Return the one of two that gains more, the first where they are nearly equal."""
    # splines of a straight spring gain nearly what ripple does, and go on as the spring does
    if first is None or 1 - other.gain <= TUNING.clearly_less * (1 - first.gain):
        return other
    return first


def _between(position: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return which positions lie between others."""
    return (position >= others.min()) & (position <= others.max())


def _candidates(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse | None,
    chosen: Collection[tuple[str, int | None]] | None = None,
) -> Iterator[_Candidate]:
    """Yield what could be selected: smooth torques, friction that varies, and ripple.

    Torques by position are those that ``rigid`` leaves, where it is given. chosen: parameters and joints; None: all.
    """
    functions, motors = model.residuals, motors_of(model)
    with torch.no_grad():
        splines, ripple = functions.splines(samples.q), functions.revolute * functions.waves(samples.q)
    joints, unit = torch.eye(len(motors)).to(motors), functions.unit.flatten()
    alike, pairs = torch.zeros(SPLINES), torch.arange(ripple.shape[-1] // 2).repeat(2)
    # a straight line, and what is not straight: a spring is known where no motion has been
    line = torch.linspace(-1, 1, SPLINES).double().unsqueeze(-1)
    varied = splines * samples.friction.unsqueeze(-1)
    kinds = (
        ("raw_torque_splines", splines, unit, joints, line, F.pad(alike + 1, (1, 0))),
        (FRICTION, varied, torch.ones(len(motors)), motors, line[:, :0], alike),
        ("raw_torque_ripple", ripple, unit, joints, torch.zeros(len(pairs), 0).double(), pairs),
    )
    for parameter, features, scale, force, lines, groups in kinds:
        for joint in range(len(motors)):
            if chosen is not None and (parameter, joint) not in chosen:
                continue
            columns = features[:, joint]
            if not columns.any() or scale[joint] <= 0:
                continue
            columns = torch.cat([columns @ lines, columns], dim=1)
            friction = None
            if parameter == FRICTION:
                friction = samples.friction[:, joint]
            elif rigid is not None:
                columns = rigid.remaining(joint, columns)
            yield _Candidate(
                parameter=parameter,
                joint=joint,
                scale=float(scale[joint]),
                position=samples.q[:, joint],
                features=columns,
                force=force[joint],
                lines=lines,
                groups=groups,
                friction=friction,
            )


def _noise(missing: torch.Tensor) -> torch.Tensor:
    deviation = missing.square().mean(dim=0).sqrt()
    return deviation.clamp(min=1e-12 * float(deviation.max()) + 1e-300)


def _halves(count: int, correlation: float) -> tuple[slice, slice]:
    """Return the first half of the samples without the gap before the last half, and the last half."""
    middle = count // 2
    return slice(0, max(0, middle - round(TUNING.gap * correlation))), slice(middle, count)


def _blocks(count: int) -> list[slice]:
    """Return as many blocks of these samples as there are folds."""
    edges = torch.linspace(0, count, TUNING.folds + 1).long().tolist()
    return [slice(start, stop) for start, stop in pairwise(edges)]


def _held_out_errors(
    candidate: _Candidate, target: torch.Tensor, correlation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what is missed (T,) of each block after a fit to the others, and which samples lie between positions of
    these.
    """
    rows, gap = _beside(candidate.features, target), round(TUNING.gap * correlation)
    everything = rows.mT @ rows
    errors, between, position = [], [], candidate.position
    for block in _blocks(len(target)):
        near = slice(max(0, block.start - gap), block.stop + gap)
        others = torch.cat([position[: near.start], position[near.stop :]])
        sums = everything - rows[near].mT @ rows[near]
        weights = _most_probable(sums, len(others), candidate.groups, correlation)
        errors.append(target[block] - candidate.torque(weights, block))
        between.append(_between(position[block], others))
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


def _fit_candidate(
    candidate: _Candidate, target: torch.Tensor, correlation: float, rows: slice = EVERY
) -> torch.Tensor:
    """Return the most probable weights (P,) after these samples."""
    samples = _beside(candidate.features[rows], target[rows])
    return _most_probable(samples.mT @ samples, len(samples), candidate.groups, correlation)


def _beside(features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return a linear model's features (T, P) with its target (T,) as the last column."""
    return torch.cat([features, target.unsqueeze(-1)], dim=1)


def _most_probable(sums: torch.Tensor, count: int, groups: torch.Tensor, correlation: float) -> torch.Tensor:
    """Return weights (P,) of a linear model, with the noise and the deviation of each group of weights at which the
    samples are most probable.

    sums: (P + 1, P + 1) of products of so many samples' features and target, see `_beside`.
    """
    gram, moment, square = sums[:-1, :-1], sums[:-1, -1], float(sums[-1, -1])
    member = F.one_hot(groups.long()).double()  # (P, groups)
    seen = gram.diagonal() > 0
    size, noise = member.sum(dim=0), square / count
    height = (member.mT @ gram.diagonal() / count / size).clamp(min=1e-300)
    precision = 10 * height * size / max(noise, 1e-300)  # a tenth of the torque, at first
    weights = torch.zeros_like(moment)
    for _ in range(TUNING.rounds):
        curvature = gram / (noise * correlation) + torch.diag(member @ precision)
        covariance = torch.linalg.inv(curvature)
        weights = covariance @ moment / (noise * correlation) * seen
        determined = (size - precision * (member.mT @ covariance.diagonal())).clamp(min=1e-9)
        precision = (determined / (member.mT @ weights.square()).clamp(min=1e-300)).clamp(max=1e14)
        missed = square - float(2 * weights @ moment - weights @ gram @ weights)
        previous, noise = noise, max(missed, 1e-12 * square) / count
        if abs(noise - previous) < TUNING.converged * previous:
            break
    return weights


def _select_networks(model: Any, samples: ResidualSamples, correlation: float) -> Iterator[SelectedResidual]:
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
    noise = _noise(missing)

    def fit(rows: slice, evaluations: int) -> None:
        chosen = ResidualSamples(*(column[rows] for column in samples))

        def cost() -> torch.Tensor:
            error = chosen.missing - residual_torque(model, *chosen[:3])
            return 0.5 * (error / noise).square().sum() / correlation

        network.load_state_dict(start)
        minimise(network, lambda: [cost()], evaluations, weight_decay=1.0)

    first, last = _halves(len(samples.q), correlation)
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
