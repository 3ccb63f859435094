"""Residual terms of single joints: torques and friction factors as linear models on samples, and their fit.

Candidates are fitted after the rigid-body and friction model, which absorbs a part of a torque of position such as a
spring. Such features are therefore compared after orthogonalization against the Jacobian of that model: a partial
regression (Frisch and Waugh, Econometrica 1:387, 1933).
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F

from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque.jacobian import ResidualSamples
from spelgen.fitting.torque.linearization import (
    BayesianRidge,
    LinearTerms,
    RigidProjection,
    append_target,
    bayesian_ridge,
)
from spelgen.runtime.residual_terms import LARGEST, SPLINES, ResidualTerms

TermKey = tuple[str, int | None]
"""Parameter of a residual term, and its joint; None: all joints."""

ALL = slice(None)
TORQUE, FRICTION, RIPPLE = "raw_torque_splines", "raw_friction_splines", "raw_torque_ripple"
LOG_FACTOR_LIMIT = 0.99 * LARGEST  # of friction's log factor: at LARGEST its parameter is infinite


@dataclass(frozen=True, eq=False)
class JointFunction:
    """A residual term of one joint, as a linear model of P = L + W weights on T samples.

    The model's parameter has W entries for the joint, in units of `scale`. Of the P weights the first L belong to
    trends over these entries (a straight line over all splines), the columns of `trends`, the others to the entries.

    position: (T,) of the joint [rad, m].
    columns: (T, P) torque per weight [Nm, N].
    features: (T, P), the columns after orthogonalization; the columns themselves if the term is a friction factor.
    direction: (n,) joint torques per torque of the term.
    groups: (P,) index of the weights' group, which has one prior precision.
    friction: (T,) friction torque, with the current factor; the weights are then the ones of the factor's logarithm,
        and columns @ weights is the torque linearized at the current factor. None: the term is a torque.
    visit_length: mean number of samples per visit of a position: a new visit begins after a motion by the spacing of
        the splines.
    """

    parameter: str
    joint: int
    scale: float
    position: torch.Tensor
    columns: torch.Tensor
    features: torch.Tensor
    direction: torch.Tensor
    trends: torch.Tensor
    groups: torch.Tensor
    friction: torch.Tensor | None
    visit_length: float

    def read(self, terms: ResidualTerms) -> torch.Tensor:
        """Return weights (P,) that represent the model's current parameter."""
        if self.friction is not None:
            entries = terms.friction_logarithms()[self.joint]
        else:
            entries = terms.get_parameter(self.parameter)[self.joint] * self.scale
        return F.pad(entries.detach(), (self.trends.shape[1], 0))

    def write(self, terms: ResidualTerms, weights: torch.Tensor) -> None:
        """Set the model's parameter to weights (P,)."""
        count = self.trends.shape[1]
        # a trend has no parameter of its own in the model, only a prior of its own in the fit
        entries = self.trends @ weights[:count] + weights[count:]
        if self.friction is not None:
            # inverse of the model's tanh, which bounds the factor
            entries = LARGEST * (entries.clamp(-LOG_FACTOR_LIMIT, LOG_FACTOR_LIMIT) / LARGEST).atanh()
        with torch.no_grad():
            terms.get_parameter(self.parameter)[self.joint] = entries / self.scale

    def torque(self, weights: torch.Tensor, rows: slice | torch.Tensor = ALL) -> torch.Tensor:
        """Return the torque (T,) [Nm, N] of weights (P,) on the samples of these rows; of a factor: its change."""
        features = self.features[rows]
        if self.friction is None:
            return features @ weights
        friction = self.friction[rows]
        # columns are splines times friction: at zero friction 0 / 0 is replaced by a log factor of zero
        log_factor = (features @ weights.clamp(-LOG_FACTOR_LIMIT, LOG_FACTOR_LIMIT)) / friction
        return friction * log_factor.nan_to_num().expm1()

    def target(self, torque_residual: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Return the torque (T,) of the term that explains a residual (T, n) best, weighted by 1 / noise^2, (n,)."""
        # least squares over the joints: coupled drives put one friction into several torques
        weight = self.direction / noise.square()
        return (torque_residual @ weight) / (self.direction @ weight)

    def fit(
        self, target: torch.Tensor, correlation_length: float, rows: slice | torch.Tensor = ALL
    ) -> BayesianRidge:
        """Return the fit to a target (T,) on the samples of these rows: samples of one visit count as one error."""
        samples = append_target(self.features[rows], target[rows])
        # a function of position has the same error during one visit of a position, however long the visit lasts
        length = max(correlation_length, self.visit_length)
        return bayesian_ridge(samples.mT @ samples, len(samples), self.groups, length)


class ProjectedTerms(NamedTuple):
    """Position-dependent torques, eliminated in a fit: the linear terms per joint, and the candidates they join."""

    terms: dict[int, LinearTerms]
    candidates: tuple[JointFunction, ...]

    def write(self, model: ArmModel, torque_residual: torch.Tensor) -> None:
        """Set the model's residual terms to the weights eliminated at a torque residual (T, n)."""
        weights = {joint: terms.weights(torque_residual[:, joint]) for joint, terms in self.terms.items()}
        for candidate in self.candidates:
            joint, count = candidate.joint, candidate.columns.shape[1]
            candidate.write(model.residuals, weights[joint][:count])
            weights[joint] = weights[joint][count:]


def refit_terms(
    model: ArmModel,
    samples: ResidualSamples,
    projection: RigidProjection,
    selected: Collection[TermKey],
    correlation_length: torch.Tensor,
) -> ProjectedTerms:
    """Refit the selected terms to the current torque residual, one after the other.

    Friction factors are written to the model. Torques of position are set to zero in the model and returned as linear
    terms with the fitted penalty: their weights are eliminated in the next fit of the rigid-body parameters.

    Args:
        model: model with residual terms.
        samples: torque residual of the model with its current terms.
        projection: of the rigid-body and friction model.
        selected: terms to refit.
        correlation_length: (n,) number of samples per independent error.
    """
    residual, noise = samples.torque_residual, rms_per_joint(samples.torque_residual)
    terms: dict[int, LinearTerms] = {}
    torques = []
    for candidate in joint_functions(model, samples, projection, selected):
        current = (candidate.features @ candidate.read(model.residuals)).unsqueeze(-1) * candidate.direction
        # one after the other, each with the latest values of the others (backfitting)
        target = candidate.target(residual + current, noise)
        fit = candidate.fit(target, float(correlation_length[candidate.joint]))
        weights = fit.coef
        changed = (candidate.features @ weights).unsqueeze(-1) * candidate.direction
        residual = residual + current - changed
        if candidate.friction is None:
            torques.append(candidate)
            columns, penalty, joint = candidate.columns, fit.penalty, candidate.joint
            if joint in terms:
                columns = torch.cat([terms[joint].features, columns], dim=1)
                penalty = torch.cat([terms[joint].penalty, penalty])
            terms[joint] = LinearTerms(columns, penalty)
            # its weights are eliminated: a copy in the model would count twice
            weights = torch.zeros_like(weights)
        candidate.write(model.residuals, weights)
    return ProjectedTerms(terms, tuple(torques))


def joint_functions(
    model: ArmModel,
    samples: ResidualSamples,
    projection: RigidProjection,
    selected: Collection[TermKey] | None = None,
) -> Iterator[JointFunction]:
    """Yield the candidates per joint: smooth torque, friction factor, ripple; None: all, else the selected ones.

    The weights of smooth torques and friction factors have one prior precision, the ones of ripple one per frequency.
    The straight line of smooth torques has a precision of its own: it extrapolates to positions without samples, as
    springs do.
    """
    terms, motors = model.residuals, motors_of(model)
    with torch.no_grad():
        splines, ripple = terms.splines(samples.q), terms.revolute * terms.waves(samples.q)
    joints, unit = torch.eye(len(motors)).to(motors), terms.unit.flatten()
    # number of visits: path length divided by the spacing of the splines
    visits = 1 + samples.q.diff(dim=0).abs().sum(dim=0) / terms.spacing.flatten()
    one_group, frequencies = torch.zeros(SPLINES), torch.arange(ripple.shape[-1] // 2).repeat(2)
    line = torch.linspace(-1, 1, SPLINES).double().unsqueeze(-1)
    friction = splines * samples.friction.unsqueeze(-1)
    no_line, no_trend = line[:, :0], torch.zeros(len(frequencies), 0).double()
    forms = (
        (TORQUE, splines, unit, joints, line, F.pad(one_group + 1, (1, 0))),
        (FRICTION, friction, torch.ones(len(motors)), motors, no_line, one_group),
        (RIPPLE, ripple, unit, joints, no_trend, frequencies),
    )
    for parameter, values, scale, directions, trends, groups in forms:
        for joint in range(len(motors)):
            if selected is not None and (parameter, joint) not in selected:
                continue
            columns = values[:, joint]
            if not columns.any() or scale[joint] <= 0:
                continue
            columns = torch.cat([columns @ trends, columns], dim=1)
            of_friction = parameter == FRICTION
            yield JointFunction(
                parameter=parameter,
                joint=joint,
                scale=float(scale[joint]),
                position=samples.q[:, joint],
                columns=columns,
                features=columns if of_friction else projection.orthogonalize(joint, columns),
                direction=directions[joint],
                trends=trends,
                groups=groups,
                friction=samples.friction[:, joint] if of_friction else None,
                visit_length=len(samples.q) / float(visits[joint]),
            )


def rms_per_joint(torque_residual: torch.Tensor) -> torch.Tensor:
    """Return the root mean square per joint (n,) of a torque residual (T, n), positive also without a residual."""
    rms = torque_residual.square().mean(dim=0).sqrt()
    return rms.clamp(min=1e-12 * float(rms.max()) + 1e-300)
