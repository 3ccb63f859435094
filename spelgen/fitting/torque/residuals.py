"""What stands beside rigid bodies, fitted to the torque that they miss: selected by cross-validation.

Bodies and friction laws were fitted alone, and have taken over what they can of a spring. A torque by position is
therefore compared as far as they cannot: a partial regression (Frisch and Waugh, Econometrica 1:387, 1933).

A function of one joint is fitted without each tenth of the samples in turn, and without a gap beside it, since errors
of neighbours are alike. It can be selected where the tenths gain, beyond luck, and where the last half of the samples
gains by it, too, after a fit to the first half: one motion often repeats what another does not. If none of a joint
gains so, they are judged between the positions that they were fitted to, since a function is known nowhere else. The
one that gains most is selected; bodies are fitted beside it before others are judged. Networks of several joints are
judged on the last half alone.

Functions are linear in their weights, which are found with their scale by maximising the marginal likelihood (MacKay,
Neural Computation 4:415, 1992); networks are found by L-BFGS from a normal distribution of their weights.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from spelgen.dynamics.protocol import motors_of
from spelgen.dynamics.residuals import residual_torque
from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque.jacobian import FollowingFunctions, ResidualSamples, RigidResponse
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
    columns: (T, P) its torque by these weights.
    features: (T, P) of torques by position, what bodies and laws cannot take over of that.
    force: (n,) how its torque acts on the joints.
    groups: (P,) which weights have a scale in common.
    friction: (T,) what the function varies, with weights of its logarithm, to which features are the linear answer.
    """

    parameter: str
    joint: int
    scale: float
    position: torch.Tensor
    columns: torch.Tensor
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


def can_be_judged(count: int, correlation: float) -> bool:
    """Return whether of so many samples both halves are more than the gap between them."""
    first, last = halves(count, correlation)
    return bool(last.start - first.stop <= first.stop)


def select_functions(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse,
    selected: Sequence[SelectedResidual],
    correlation: float,
) -> list[SelectedResidual]:
    """Return, of each joint, the function beside those selected by which held-out samples gain most, if any do.

    correlation: samples that err alike.
    """
    noise, joints = _noise(samples.missing), range(samples.q.shape[1])
    known = {(residual.name, residual.joint) for residual in selected}
    candidates: list[list[_Candidate]] = [[] for _ in joints]
    for candidate in _candidates(model, samples, rigid):
        if (candidate.parameter, candidate.joint) not in known:
            candidates[candidate.joint].append(candidate)
    best = (_best(of_joint, samples.missing, noise, correlation) for of_joint in candidates)
    return [residual for residual in best if residual is not None]


def clear_functions(model: Any, joints: Iterable[int]) -> None:
    """Leave the model without functions of these joints."""
    functions = model.residuals
    with torch.no_grad():
        for weights in (
            functions.raw_torque_splines,
            functions.raw_friction_splines,
            functions.raw_torque_ripple,
        ):
            weights[list(joints)] = 0.0


class FollowingResiduals(NamedTuple):
    """Torques by position that are to follow bodies, with the penalties (P,) of their weights."""

    penalties: tuple[tuple[_Candidate, torch.Tensor], ...]

    def by_joint(self) -> dict[int, FollowingFunctions]:
        """Return all functions of each joint as one."""
        functions: dict[int, FollowingFunctions] = {}
        for candidate, penalty in self.penalties:
            columns, joint = candidate.columns, candidate.joint
            if joint in functions:
                columns = torch.cat([functions[joint].features, columns], dim=1)
                penalty = torch.cat([functions[joint].penalty, penalty])
            functions[joint] = FollowingFunctions(columns, penalty)
        return functions

    def write(self, model: Any, missing: torch.Tensor) -> None:
        """Give the model what they explain of the torque that bodies leave (T, n)."""
        weights = {
            joint: functions.weights(missing[:, joint]) for joint, functions in self.by_joint().items()
        }
        for candidate, penalty in self.penalties:
            of_candidate, weights[candidate.joint] = weights[candidate.joint].tensor_split((len(penalty),))
            candidate.write(model.residuals, of_candidate)


def refit_residuals(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse,
    selected: Sequence[SelectedResidual],
    correlation: float,
) -> FollowingResiduals:
    """Fit the selected functions of single joints anew, beside what else has changed since.

    Friction is fitted to all that is missed. Torques by position are as large as what bodies and laws cannot explain
    says; the model is left without them, and they are to follow bodies.
    """
    noise, missing, functions = _noise(samples.missing), samples.missing, model.residuals
    chosen = {(residual.name, residual.joint) for residual in selected}
    penalties = []
    for candidate in _candidates(model, samples, rigid, chosen):
        present = (candidate.features @ candidate.weights(functions)).unsqueeze(-1) * candidate.force
        target = candidate.target(missing + present, noise)
        weights, penalty = _fit_candidate(candidate, target, correlation)
        changed = (candidate.features @ weights).unsqueeze(-1) * candidate.force
        missing = missing + present - changed
        if candidate.friction is None:
            penalties.append((candidate, penalty))
            weights = torch.zeros_like(weights)
        candidate.write(functions, weights)
    return FollowingResiduals(tuple(penalties))


def _best(
    candidates: Sequence[_Candidate], missing: torch.Tensor, noise: torch.Tensor, correlation: float
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
        weights, _ = _fit_candidate(candidate, target, correlation, first)
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


def between_positions(position: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return which positions (T, ...) lie between others (T', ...)."""
    return (position >= others.amin(dim=0)) & (position <= others.amax(dim=0))


def _candidates(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse,
    chosen: Collection[tuple[str, int | None]] | None = None,
) -> Iterator[_Candidate]:
    """Yield what could be selected: smooth torques, friction that varies, and ripple.

    chosen: parameters and joints; None: all.
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
            of_friction = parameter == FRICTION
            yield _Candidate(
                parameter=parameter,
                joint=joint,
                scale=float(scale[joint]),
                position=samples.q[:, joint],
                columns=columns,
                features=columns if of_friction else rigid.remaining(joint, columns),
                force=force[joint],
                lines=lines,
                groups=groups,
                friction=samples.friction[:, joint] if of_friction else None,
            )


def _noise(missing: torch.Tensor) -> torch.Tensor:
    deviation = missing.square().mean(dim=0).sqrt()
    return deviation.clamp(min=1e-12 * float(deviation.max()) + 1e-300)


def halves(count: int, correlation: float) -> tuple[slice, slice]:
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
        weights, _ = _most_probable(sums, len(others), candidate.groups, correlation)
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


def _fit_candidate(
    candidate: _Candidate, target: torch.Tensor, correlation: float, rows: slice = EVERY
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the most probable weights (P,) after these samples, with their penalties, see `_most_probable`."""
    samples = _beside(candidate.features[rows], target[rows])
    return _most_probable(samples.mT @ samples, len(samples), candidate.groups, correlation)


def _beside(features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return a linear model's features (T, P) with its target (T,) as the last column."""
    return torch.cat([features, target.unsqueeze(-1)], dim=1)


def _most_probable(
    sums: torch.Tensor, count: int, groups: torch.Tensor, correlation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return weights (P,) of a linear model, with the noise and the deviation of each group of weights at which the
    samples are most probable; and penalties (P,) of the weights' squares, in squares of the target, which lead there.

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
        penalty = noise * correlation * (member @ precision)
        curvature = gram / (noise * correlation) + torch.diag(member @ precision)
        covariance = torch.linalg.inv(curvature)
        weights = covariance @ moment / (noise * correlation) * seen
        determined = (size - precision * (member.mT @ covariance.diagonal())).clamp(min=1e-9)
        precision = (determined / (member.mT @ weights.square()).clamp(min=1e-300)).clamp(max=1e14)
        missed = square - float(2 * weights @ moment - weights @ gram @ weights)
        previous, noise = noise, max(missed, 1e-12 * square) / count
        if abs(noise - previous) < TUNING.converged * previous:
            break
    return weights, penalty


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
    noise = _noise(missing)

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
