"""Functions of single joints that stand beside rigid bodies: what they are on samples, and their fit.

They are linear in their weights, which are found with their scale by maximising the marginal likelihood (MacKay,
Neural Computation 4:415, 1992). Bodies and friction laws were fitted alone, and have taken over what they can of a
spring. A torque by position is therefore compared as far as they cannot: a partial regression (Frisch and Waugh,
Econometrica 1:387, 1933).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from spelgen.dynamics.protocol import motors_of
from spelgen.fitting.torque.jacobian import FollowingFunctions, ResidualSamples, RigidResponse
from spelgen.fitting.torque.tuning import ResidualTuning
from spelgen.runtime.residual_terms import LARGEST, SPLINES

TUNING = ResidualTuning()

EVERY = slice(None)
FRICTION = "raw_friction_splines"
WIDEST = 0.99 * LARGEST  # weights of friction's logarithm: beyond, the model's own are infinite


@dataclass(frozen=True, eq=False)
class JointFunction:
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


class FollowingResiduals(NamedTuple):
    """Torques by position that are to follow bodies: the functions of each joint as one, and what these are made of."""

    functions: dict[int, FollowingFunctions]
    candidates: tuple[JointFunction, ...]

    def write(self, model: Any, missing: torch.Tensor) -> None:
        """Give the model what they explain of the torque that bodies leave (T, n)."""
        weights = {joint: of_joint.weights(missing[:, joint]) for joint, of_joint in self.functions.items()}
        for candidate in self.candidates:
            joint, count = candidate.joint, candidate.columns.shape[1]
            candidate.write(model.residuals, weights[joint][:count])
            weights[joint] = weights[joint][count:]


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


def refit_residuals(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse,
    chosen: Collection[tuple[str, int | None]],
    correlation: float,
) -> FollowingResiduals:
    """Fit the chosen functions, by parameter and joint, anew, beside what else has changed since.

    Friction is fitted to all that is missed. Torques by position are as large as what bodies and laws cannot explain
    says; the model is left without them, and they are to follow bodies.
    """
    noise, missing, functions = deviations(samples.missing), samples.missing, model.residuals
    following: dict[int, FollowingFunctions] = {}
    candidates = []
    for candidate in joint_functions(model, samples, rigid, chosen):
        present = (candidate.features @ candidate.weights(functions)).unsqueeze(-1) * candidate.force
        target = candidate.target(missing + present, noise)
        weights, penalty = fit_function(candidate, target, correlation)
        changed = (candidate.features @ weights).unsqueeze(-1) * candidate.force
        missing = missing + present - changed
        if candidate.friction is None:
            candidates.append(candidate)
            columns, joint = candidate.columns, candidate.joint
            if joint in following:
                columns = torch.cat([following[joint].features, columns], dim=1)
                penalty = torch.cat([following[joint].penalty, penalty])
            following[joint] = FollowingFunctions(columns, penalty)
            weights = torch.zeros_like(weights)
        candidate.write(functions, weights)
    return FollowingResiduals(following, tuple(candidates))


def joint_functions(
    model: Any,
    samples: ResidualSamples,
    rigid: RigidResponse,
    chosen: Collection[tuple[str, int | None]] | None = None,
) -> Iterator[JointFunction]:
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
            yield JointFunction(
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


def deviations(missing: torch.Tensor) -> torch.Tensor:
    deviation = missing.square().mean(dim=0).sqrt()
    return deviation.clamp(min=1e-12 * float(deviation.max()) + 1e-300)


def fit_function(
    candidate: JointFunction, target: torch.Tensor, correlation: float, rows: slice = EVERY
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the most probable weights (P,) after these samples, with their penalties, see `most_probable`."""
    samples = beside(candidate.features[rows], target[rows])
    return most_probable(samples.mT @ samples, len(samples), candidate.groups, correlation)


def beside(features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return a linear model's features (T, P) with its target (T,) as the last column."""
    return torch.cat([features, target.unsqueeze(-1)], dim=1)


def most_probable(
    sums: torch.Tensor, count: int, groups: torch.Tensor, correlation: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return weights (P,) of a linear model, with the noise and the deviation of each group of weights at which the
    samples are most probable; and penalties (P,) of the weights' squares, in squares of the target, which lead there.

    sums: (P + 1, P + 1) of products of so many samples' features and target, see `beside`.
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
