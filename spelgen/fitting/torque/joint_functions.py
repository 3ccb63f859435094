"""Residual terms of single joints: torques and friction factors as linear models on samples, and their fit.

Residual terms are fitted to the residual of the rigid-body and friction model. This model has already absorbed a part
of a position-dependent torque such as a spring. The features of such torques are therefore orthogonalized against the
Jacobian of the model: a partial regression (Frisch and Waugh, Econometrica 1:387, 1933).
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
# Largest fitted logarithm of a friction factor. In the model, the logarithm is LARGEST tanh(parameter / LARGEST): a
# logarithm of LARGEST would need an infinite parameter.
LOG_FACTOR_LIMIT = 0.99 * LARGEST


@dataclass(frozen=True, eq=False)
class JointFunction:
    """A residual term of one joint, as a linear model with P = L + W weights on T samples.

    The term has W entries e (W,), for example the spline coefficients of the joint. The weights w (P,) are L amplitudes
    of trends, which change all entries together (for example mean and slope of the spline coefficients), and W changes
    of single entries: e = trends @ w[:L] + w[L:].

    scale: unit of the entries [Nm, N], or 1 for a friction factor; the parameter of the model is e / scale.
    position: (T,) position of the joint [rad, m].
    columns: (T, P) torque per weight [Nm, N].
    features: (T, P) columns after orthogonalization, without the part of the columns that rigid bodies and friction
        would absorb. For a friction factor, the features are the columns without orthogonalization: divided by
        `friction`, they must remain the splines from which the factor is computed.
    direction: (n,) joint torques per unit torque of the term, since a coupled drive acts on several joints.
    trends: (W, L) changes of the entries per unit weight of each trend.
    groups: (P,) index of the group of each weight; a group has one prior precision.
    friction: (T,) friction torque [Nm, N] with the current factor, if the term is a friction factor; None: the term is
        a torque. The weights of a friction factor f determine log(f) = columns @ weights / friction, and columns @
        weights is the change of the friction torque to first order.
    visit_length: mean number of samples of a visit. A visit of a position is a run of samples in which the joint moves
        by the knot spacing of the splines; its samples count as one independent error.
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
        """Return weights w (P,) that represent the current entries of this term in `terms`, the model's residual terms.

        The entries, such as spline coefficients, are trends @ w[:L] + w[L:] (see the class). Here the weights w[:L] of
        the L trends are zero, and w[L:] are the entries.
        """
        if self.friction is not None:
            entries = terms.friction_logarithms()[self.joint]
        else:
            entries = terms.get_parameter(self.parameter)[self.joint] * self.scale
        return F.pad(entries.detach(), (self.trends.shape[1], 0))

    def write(self, terms: ResidualTerms, weights: torch.Tensor) -> None:
        """Set the term's parameter in `terms` to the values that weights (P,) of the `JointFunction` represent."""
        count = self.trends.shape[1]
        # The model stores only the W entries, such as spline coefficients. Trends, such as a line through the
        # coefficients, have weights of their own only in the fit, since these weights have a separate prior. Here they
        # are added to the entries.
        entries = self.trends @ weights[:count] + weights[count:]
        if self.friction is not None:
            # The model bounds the logarithm of a friction factor by a tanh, which is inverted here.
            entries = LARGEST * (entries.clamp(-LOG_FACTOR_LIMIT, LOG_FACTOR_LIMIT) / LARGEST).atanh()
        with torch.no_grad():
            terms.get_parameter(self.parameter)[self.joint] = entries / self.scale

    def torque(self, weights: torch.Tensor, rows: slice | torch.Tensor = ALL) -> torch.Tensor:
        """Return the part of the torque residual (T,) [Nm, N] that weights (P,) explain at the samples `rows`.

        If the term is an added torque, the result is `features` @ weights: the torque without the part that rigid
        bodies and friction would absorb. If the term is a factor f of the friction, the result is (f - 1) times the
        friction torque of the model, whose present factor, 1 for a term that is not selected yet, f multiplies.
        """
        features = self.features[rows]
        if self.friction is None:
            return features @ weights
        friction = self.friction[rows]
        # The `features` of a friction factor are splines times friction. Divided by friction, their product with the
        # weights is the logarithm of the factor. At zero friction, 0 / 0 is replaced by zero.
        log_factor = (features @ weights.clamp(-LOG_FACTOR_LIMIT, LOG_FACTOR_LIMIT)) / friction
        return friction * log_factor.nan_to_num().expm1()

    def target(self, torque_residual: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Return the torque of this residual term at each sample that explains the torque residual best, (T,) [Nm, N].

        A torque x of the term adds x d to the joint torques, with the constant vector d = `direction` (n,). At each
        sample, x minimizes the sum over joints of (residual - x d)^2 / noise^2. The term is fitted to these values.
        torque_residual: (T, n) [Nm, N]. noise: (n,) standard deviations of the torque noise [Nm, N].
        """
        # The friction of a coupled drive acts on several joints, each with its own residual and noise. The returned
        # value is the weighted least-squares solution over these joints.
        weight = self.direction / noise.square()
        return (torque_residual @ weight) / (self.direction @ weight)

    def fit(
        self, target: torch.Tensor, correlation_length: float, rows: slice | torch.Tensor = ALL
    ) -> BayesianRidge:
        """Return the Bayesian ridge fit of the weights to a target torque (T,) [Nm, N] at the samples `rows`.

        The number of samples that count as one independent error is ``correlation_length``, or ``visit_length`` if this
        is larger: while the joint remains near a position, the error of a function of position remains constant.
        """
        samples = append_target(self.features[rows], target[rows])
        # The error of a function of position is constant during a visit of a position: the samples of a visit count as
        # one error, however long the visit lasts.
        length = max(correlation_length, self.visit_length)
        return bayesian_ridge(samples.mT @ samples, len(samples), self.groups, length)


class ProjectedTerms(NamedTuple):
    """Position-dependent residual torques whose weights a fit eliminates by variable projection.

    candidates: the residual terms; each acts on one joint, and a joint may have several. terms: {joint: `LinearTerms`
    of the joint}, whose features are the columns of all residual terms of the joint, in the order of the candidates.
    """

    terms: dict[int, LinearTerms]
    candidates: tuple[JointFunction, ...]

    def write(self, model: ArmModel, torque_residual: torch.Tensor) -> None:
        """Compute the eliminated weights by ridge regression, and write them to the model.

        torque_residual: residual (T, n) [Nm, N] of the model without the eliminated terms.
        """
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

    A term is fitted to the residual of the rigid-body and friction model and of the other terms. For a torque, the
    `features` are orthogonalized: the fitted weights are the same as in a simultaneous fit of the term and the rigid
    bodies (theorem of Frisch, Waugh and Lovell). Friction factors are written to the model. Position-dependent torques
    are returned as linear terms, with the fitted penalty of their weights, and are set to zero in the model: in the
    next fit of the rigid-body parameters, their weights are eliminated by variable projection.

    Args:
        model: model with residual terms.
        samples: samples with the torque residual of the model with its current residual terms.
        projection: projection onto the rigid-body and friction model.
        selected: (parameter, joint) of the terms to refit.
        correlation_length: (n,) number of samples per independent error.
    """
    residual, noise = samples.torque_residual, rms_per_joint(samples.torque_residual)
    terms: dict[int, LinearTerms] = {}
    torques = []
    for candidate in joint_functions(model, samples, projection, selected):
        current = (candidate.features @ candidate.read(model.residuals)).unsqueeze(-1) * candidate.direction
        # Backfitting: each term is fitted to the residual of all other terms with their latest values.
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
            # The next fit will eliminate the weights of a position-dependent torque by variable projection. The torque
            # in the model is set to zero, or it would count twice.
            weights = torch.zeros_like(weights)
        candidate.write(model.residuals, weights)
    return ProjectedTerms(terms, tuple(torques))


def joint_functions(
    model: ArmModel,
    samples: ResidualSamples,
    projection: RigidProjection,
    selected: Collection[TermKey] | None = None,
) -> Iterator[JointFunction]:
    """Yield the candidate terms of each joint (smooth torque, friction factor, ripple), or only the selected ones.

    A smooth torque is a spline over the position of the joint. A friction factor, which multiplies the friction of the
    joint, is the exponential of such a spline. The coefficients of a spline have one common prior precision. A smooth
    torque also contains a straight line over the position: at positions without samples, the spline is near zero, and
    the line continues the torque of a spring. Mean and slope of the line have prior precisions of their own. Ripple is
    a sum of sines and cosines of the position, with one precision per frequency. Frequencies with less than two periods
    within the samples are omitted: they would fit a trend, and be wrong at other positions.

    projection: removes from a torque the part that the rigid-body and friction model would absorb. selected:
    (parameter, joint) of the terms to yield; None: all.
    """
    terms, motors = model.residuals, motors_of(model)
    with torch.no_grad():
        splines, ripple = terms.splines(samples.q), terms.revolute * terms.waves(samples.q)
    joints, unit = torch.eye(len(motors)).to(motors), terms.unit.flatten()
    # A visit is a run of samples in which a joint moves by one knot spacing of the splines (see
    # `JointFunction.visit_length`). The number of visits is therefore path length / knot spacing, plus 1, since a joint
    # at rest makes one visit.
    visits = 1 + samples.q.diff(dim=0).abs().sum(dim=0) / terms.spacing.flatten()
    one_group, frequencies = torch.zeros(SPLINES), torch.arange(ripple.shape[-1] // 2).repeat(2)
    # Ripple of a frequency needs a range of positions of at least two periods: width >= 2 * 2 pi / frequency.
    width = (samples.q.amax(dim=0) - samples.q.amin(dim=0)).unsqueeze(-1)
    ripple = ripple * (terms.frequencies * width >= 4 * torch.pi).repeat(1, 2)
    friction = splines * samples.friction.unsqueeze(-1)
    line = torch.stack([torch.ones(SPLINES), torch.linspace(-1, 1, SPLINES)], dim=1).double()
    mean_slope_others = torch.arange(SPLINES + 2).clamp(max=2)
    no_line, no_trend = line[:, :0], torch.zeros(len(frequencies), 0).double()
    forms = (
        (TORQUE, splines, unit, joints, line, mean_slope_others),
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
    """Return the root mean square (n,) of a torque residual (T, n), used as noise, with a tiny lower bound."""
    rms = torque_residual.square().mean(dim=0).sqrt()
    return rms.clamp(min=1e-12 * float(rms.max()) + 1e-300)
