"""What stands beside rigid bodies, fitted to the torque that they miss: only as far as held-out samples ask for it.

Each part is fitted without every tenth of the samples in turn and judged on that tenth: it enters where the tenths as a
whole gain, beyond luck. What enters is linear in its weights joint by joint, found with the scale of its weights by
maximising the marginal likelihood (MacKay, Neural Computation 4:415, 1992); networks of several joints are found by
L-BFGS from a normal distribution of their weights.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from spelgen.fitting.optimizers import minimise
from spelgen.fitting.torque_jacobian import Left
from spelgen.runtime.joint_functions import LARGEST

TENTHS = 10  # blocks of samples that are held out
SURE = 2.82  # standard errors of the mean gain of a block: 1 % of luck, by Student's t of nine degrees of freedom
LEAST_GAIN = 1e-3  # of the squares that are missed: what explains less is not worth a function
ROUNDS = 30  # of the marginal likelihood's fixed point
CONVERGED = 1e-3  # relative change of the noise
NETWORK_SAMPLES = 2**12
NETWORK_FOLDS = 2  # a network is fitted this often to be judged
EVALUATIONS = 100  # of a network's loss
FRICTION = "raw_friction_splines"
WIDEST = 0.99 * LARGEST  # weights of friction's logarithm: beyond, the model's own are infinite


@dataclass(frozen=True)
class Residual:
    """A part that entered. gain: of the squares of the torque that was missed where it acts, in held-out samples."""

    name: str
    joint: int | None
    gain: float


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A function of one joint: its weights are a row of the model's parameter of that name, in units of ``scale``.

    features: (T, P). force: (n,) how its torque acts on the joints. groups: (P,) which weights have a scale in common.
    friction: (T,) what the function varies, with weights of its logarithm, to which features are the linear answer.
    """

    parameter: str
    joint: int
    scale: float
    features: torch.Tensor
    force: torch.Tensor
    groups: torch.Tensor
    friction: torch.Tensor | None

    def weights(self, functions: Any) -> torch.Tensor:
        """The model's, (P,)."""
        if self.friction is not None:
            return functions.friction_logarithms()[self.joint].detach()
        return functions.get_parameter(self.parameter)[self.joint].detach() * self.scale

    def write(self, functions: Any, weights: torch.Tensor) -> None:
        """Make them the model's."""
        if self.friction is not None:
            weights = LARGEST * (weights.clamp(-WIDEST, WIDEST) / LARGEST).atanh()
        with torch.no_grad():
            functions.get_parameter(self.parameter)[self.joint] = weights / self.scale

    def chunks(self) -> Iterator[_Candidate]:
        """The same of each tenth of the samples."""
        friction = [None] * TENTHS if self.friction is None else self.friction.chunk(TENTHS)
        for features, each in zip(self.features.chunk(TENTHS), friction, strict=True):
            yield replace(self, features=features, friction=each)

    def torque(self, weights: torch.Tensor) -> torch.Tensor:
        """What they add, (T,)."""
        if self.friction is None:
            return self.features @ weights
        logarithm = (self.features @ weights.clamp(-WIDEST, WIDEST)) / self.friction
        return self.friction * logarithm.nan_to_num().expm1()

    def target(self, missing: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """What of the missing torque (T, n) the function could be, (T,)."""
        weight = self.force / noise.square()
        return (missing @ weight) / (self.force @ weight)


def enter(model: Any, left: Left, alike: float) -> list[Residual]:
    """Give the model all parts that held-out samples ask for; what entered. alike: samples that err alike."""
    noise, missing, found = _noise(left.missing), left.missing, []
    functions = model.joint_functions
    for each in _candidates(model, left):
        target = each.target(missing, noise)
        gain = _held_out(each, target, alike)
        if gain is None:
            continue
        weights = _weights(each, target, alike)
        each.write(functions, weights)
        missing = missing - each.torque(weights).unsqueeze(-1) * each.force
        found.append(Residual(each.parameter, each.joint, gain))
    return [*found, *_networks(model, left._replace(missing=missing), alike)]


def refine(model: Any, left: Left, entered: Sequence[Residual], alike: float) -> None:
    """Fit the functions of single joints that have entered anew, beside what else has changed since."""
    noise, missing, functions = _noise(left.missing), left.missing, model.joint_functions
    chosen = {(each.name, each.joint) for each in entered}
    for each in _candidates(model, left):
        if (each.parameter, each.joint) not in chosen:
            continue
        own = (each.features @ each.weights(functions)).unsqueeze(-1) * each.force
        weights = _weights(each, each.target(missing + own, noise), alike)
        each.write(functions, weights)
        missing = missing + own - (each.features @ weights).unsqueeze(-1) * each.force


def _candidates(model: Any, left: Left) -> Iterator[_Candidate]:
    """What could enter: smooth torques first, then friction that varies, then ripple."""
    functions, motors = model.joint_functions, model.motors
    with torch.no_grad():
        splines, ripple = functions.splines(left.q), functions.ripple(left.q)
    own = torch.eye(len(motors)).to(motors)
    together = torch.zeros(splines.shape[-1])
    pairs = torch.arange(ripple.shape[-1] // 2).repeat(2)
    kinds = (
        ("raw_torque_splines", splines, functions.scale, own, together),
        (FRICTION, splines * left.friction.unsqueeze(-1), torch.ones(len(motors)), motors, together),
        ("raw_torque_ripple", ripple, functions.scale, own, pairs),
    )  # fmt: skip
    for parameter, features, scale, force, groups in kinds:
        for joint in range(len(motors)):
            if features[:, joint].any() and scale[joint] > 0:
                varied = left.friction[:, joint] if parameter == FRICTION else None
                yield _Candidate(
                    parameter, joint, float(scale[joint]), features[:, joint], force[joint], groups, varied
                )


def _noise(missing: torch.Tensor) -> torch.Tensor:
    deviation = missing.square().mean(dim=0).sqrt()
    return deviation.clamp(min=1e-12 * float(deviation.max()) + 1e-300)


def _held_out(candidate: _Candidate, target: torch.Tensor, alike: float) -> float | None:
    """The part of the target's squares that is explained where it was not seen; None: no more than luck explains."""
    blocks = [*zip(candidate.chunks(), target.chunk(TENTHS), strict=True)]
    grams = torch.stack([x.features.mT @ x.features for x, _ in blocks])
    moments = torch.stack([x.features.mT @ y for x, y in blocks])
    squares = torch.stack([y @ y for _, y in blocks])
    left = []
    for index, (x, y) in enumerate(blocks):
        weights = _probable(
            grams.sum(dim=0) - grams[index],
            moments.sum(dim=0) - moments[index],
            float(squares.sum() - squares[index]),
            len(target) - len(y),
            candidate.groups,
            alike,
        )
        left.append((y - x.torque(weights)).square().sum())
    return _sure_gain(squares, torch.stack(left))


def _sure_gain(before: torch.Tensor, after: torch.Tensor) -> float | None:
    """The part by which sums of squares of blocks fell; None where luck could do that, or it is next to nothing."""
    gains = before - after
    error = gains.std() / len(gains) ** 0.5
    sure = bool(gains.mean() > SURE * error) and bool(gains.isfinite().all())
    part = float(gains.sum() / before.sum()) if sure else 0.0
    return part if part > LEAST_GAIN else None


def _weights(candidate: _Candidate, target: torch.Tensor, alike: float) -> torch.Tensor:
    """The most probable weights (P,) after all samples."""
    x = candidate.features
    return _probable(x.mT @ x, x.mT @ target, float(target @ target), len(x), candidate.groups, alike)


def _probable(
    gram: torch.Tensor,
    moment: torch.Tensor,
    square: float,
    count: int,
    groups: torch.Tensor,
    alike: float,
) -> torch.Tensor:
    """Weights (P,) of a linear model from X^T X, X^T y and y^T y, with the noise and the deviation of each group of
    weights at which the samples are most probable.
    """
    member = torch.nn.functional.one_hot(groups.long()).double()  # (P, groups)
    seen = gram.diagonal() > 0
    size, noise = member.sum(dim=0), square / count
    height = (member.mT @ gram.diagonal() / count / size).clamp(min=1e-300)
    precision = 10 * height * size / max(noise, 1e-300)  # a tenth of the torque, at first
    for _ in range(ROUNDS):
        curvature = gram / (noise * alike) + torch.diag(member @ precision)
        covariance = torch.linalg.inv(curvature)
        weights: torch.Tensor = covariance @ moment / (noise * alike) * seen
        determined = (size - precision * (member.mT @ covariance.diagonal())).clamp(min=1e-9)
        precision = (determined / (member.mT @ weights.square()).clamp(min=1e-300)).clamp(max=1e14)
        left = max(square - float(2 * weights @ moment - weights @ gram @ weights), 1e-12 * square) / count
        if abs(left - noise) < CONVERGED * noise:
            break
        noise = left
    return weights


def _networks(model: Any, left: Left, alike: float) -> Iterator[Residual]:
    """The networks that enter: the potential's, then the mass matrix's."""
    dynamics = model
    every = -(-len(left.q) // NETWORK_SAMPLES)
    few = Left(*(x[::every] for x in left))
    for name in ("residual_potential", "residual_mass"):
        network = getattr(dynamics, name)
        if network is None:
            continue
        gain = _fit_network(dynamics, network, few, max(1.0, alike / every))
        if gain is None:
            continue
        with torch.no_grad():
            torque = _network_torque(dynamics, few)
            few = few._replace(missing=few.missing - torque)
        yield Residual(name, None, gain)


def _fit_network(dynamics: Any, network: torch.nn.Module, left: Left, alike: float) -> float | None:
    """Fit one network where that pays on held-out samples, else leave it as it is; the gain there."""
    start, noise = copy.deepcopy(network.state_dict()), _noise(left.missing)
    with torch.no_grad():
        before = _network_torque(dynamics, left)
    blocks = torch.arange(len(left.q)) * TENTHS // len(left.q)

    def loss(rows: torch.Tensor) -> Callable[[], torch.Tensor]:
        chosen = Left(*(x[rows] for x in left))

        def missed() -> torch.Tensor:
            away = chosen.missing - _network_torque(dynamics, chosen) + before[rows]
            return 0.5 * (away / noise).square().sum() / alike

        return missed

    squares = torch.zeros(TENTHS).double()
    for fold in range(NETWORK_FOLDS):
        out = blocks % NETWORK_FOLDS == fold
        network.load_state_dict(start)
        minimise(network, loss(~out), EVALUATIONS, weight_decay=1.0)
        with torch.no_grad():
            away = (left.missing - _network_torque(dynamics, left) + before) / noise
        squares.index_add_(0, blocks[out], away[out].square().sum(dim=1))
    still = torch.zeros(TENTHS).double()
    still.index_add_(0, blocks, (left.missing / noise).square().sum(dim=1))
    gain = _sure_gain(still, squares)
    network.load_state_dict(start)
    if gain is not None:
        minimise(network, loss(blocks >= 0), EVALUATIONS, weight_decay=1.0)
    dynamics.zero_grad(set_to_none=True)
    return gain


def _network_torque(dynamics: Any, left: Left) -> torch.Tensor:
    torque: torch.Tensor = dynamics.residual_torque(left.q, left.qd, left.qdd, dynamics.prepare())
    return torque
