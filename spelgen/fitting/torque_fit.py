"""Fit rigid bodies to torques: their most probable weights, by Gauss-Newton steps (Levenberg-Marquardt).

The torque is linear in the bodies' parameters, which the log-Cholesky weights make possible ones, and smooth in the
few constants of each joint: seconds are enough, and no step size is to be chosen. What is minimised is

    sum over joints and samples of (missing torque / noise)^2 + (weights - start)^T covariance^-1 (weights - start),

with the covariance of a Gaussian prior (see ``covariance``). Where gains between logged and joint torques are trained,
what is missed is told in the logged ones, else all torques would shrink with their gains. The noise of a joint is what
is left of its torque, found in rounds, and so is how far the start is to be believed (see ``most_probable``). Sums over
samples are made block by block, so that memory does not grow with the logs. What a model has beside rigid bodies is
fitted to what these leave, where it pays (see ``residual_fit``), and then both in turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.dynamics.protocol import has_residuals
from spelgen.fitting.gaussian_prior import PRIORS, covariance, most_probable
from spelgen.fitting.levenberg_marquardt import TUNING as DAMPING
from spelgen.fitting.levenberg_marquardt import NormalEquations, SolverState, levenberg_marquardt
from spelgen.fitting.residual_fit import Residual, enter, refine
from spelgen.fitting.torque_jacobian import COMPENSATION, TorqueJacobian
from spelgen.fitting.torque_samples import TorqueSamples
from spelgen.identification.samples import DynamicsSamples
from spelgen.settings.fits import Adaptation, GaussianPrior

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

DECIMATION = (
    2  # samples taken of so many: filtered at 8 Hz and sampled at 100 Hz they say all that is to be said
)
ALIKE = 20.0  # of those: so many in a row, 0.4 s, err alike and count once
ROUNDS = 8  # of weighing joints by what is left of their torque, and the start by how far it was left;
LONGER, ENDED = 4, 0.98  # so many times as many while some joint's noise falls by more than that
FIRST_ROUNDS = 3  # after which it is seen whether friction explains what is missed
COMPENSATED = 0.1  # of what is missed: explained by a drive that adds torque with velocity,
SIGNIFICANT = 4.0  # by so many standard deviations,
VISIBLE = 0.05  # and so much of the torque's deviation: milliseconds between torque and motion look alike, but smaller
STEPS = 5  # at most in a round
LARGE = 2**15  # samples; of more, FEW of them are fitted first
FEW, LAST_ROUNDS = 2**14, 2
TURNS = 3  # of rigid bodies and what stands beside them, where something does
GAIN = 1e-4  # relative: a step that gains less ends a round
FIRST_NOISE = 0.1  # of a joint's torque range
LEAST_NOISE = 1e-4  # likewise: noise-free samples are fitted to four digits of their torque's range


@dataclass(frozen=True, eq=False)
class TorqueSolution:
    """How a fit ended.

    residual: (n,) root mean square of the torque that is missed [Nm, N]. prior: as the fit found it. covariance: of the
    weights after the fit (K, K), zero for those that did not move. compensated: (n,) joints whose drives add torque
    that is not measured. residuals: what entered beside rigid bodies.
    """

    residual: np.ndarray
    steps: int
    cost: float
    prior: GaussianPrior
    covariance: torch.Tensor
    compensated: np.ndarray
    residuals: tuple[Residual, ...]


_State = SolverState[torch.Tensor]  # its residuals: sums of squares of the torque that is missed (n,)


def fit_torque(
    model: EmittedModel,
    samples: TorqueSamples | Sequence[DynamicsSamples],
    prior: GaussianPrior | None = None,
    adapt: Adaptation | None = None,
) -> TorqueSolution:
    """Set the weights of a closed-form ``model`` to the most probable ones after ``samples`` (torques as logged).

    The prior is centred on the weights as they are. ``adapt``: these move alone, what stands beside rigid bodies stays
    as it is, and so does the prior of a load (see ``TorqueFit``).
    """
    if not isinstance(samples, TorqueSamples):
        samples = TorqueSamples.held(samples, DECIMATION)
    large = samples.count > LARGE
    few = samples.thinned(FEW) if large else samples
    prior = prior or (PRIORS[adapt] if adapt else GaussianPrior())
    problem = _Problem(TorqueJacobian(model, few), prior, adapt)
    at, noise = problem.settled()
    residuals: list[Residual] = []
    if adapt is None and has_residuals(model):
        alike = max(1.0, ALIKE * few.count / samples.count)
        problem.jacobian.write(at.x)
        residuals = enter(model, problem.jacobian.left(at.x), alike)
        for _ in range(TURNS if residuals else 0):
            at = problem.again(at, TorqueJacobian(model, few))
            at, noise = problem.solve(at, problem.noise(at.residuals), LAST_ROUNDS)
            problem.jacobian.write(at.x)
            refine(model, problem.jacobian.left(at.x), residuals, alike)
        if residuals:  # seen with what was refined last
            at = problem.again(at, TorqueJacobian(model, few))
    if large:  # few of many samples came near, all of them finish
        at, _ = problem.solve(problem.again(at, TorqueJacobian(model, samples)), noise, LAST_ROUNDS)
    problem.jacobian.write(at.x)
    return TorqueSolution(
        residual=((at.residuals / samples.count).sqrt() / problem.jacobian.per_gain(at.x)).numpy(),
        steps=at.steps,
        cost=at.cost,
        prior=problem.prior,
        covariance=problem.covariance,
        compensated=problem.compensated.numpy(),
        residuals=tuple(residuals),
    )


class _Problem:
    def __init__(self, jacobian: TorqueJacobian, prior: GaussianPrior, adapt: Adaptation | None) -> None:
        self.start, self.guess, self.adapt = jacobian.start, prior, adapt
        self.compensated = jacobian.weights[COMPENSATION] != 0
        self.covariance = torch.zeros(len(self.start), len(self.start)).double()
        self.take(jacobian)
        self.believe(prior)

    def take(self, jacobian: TorqueJacobian) -> None:
        """Go on with these samples."""
        self.jacobian, self.count = jacobian, jacobian.samples.count
        deviation = jacobian.torque_deviation()
        self.range = torch.maximum(deviation, 1e-3 * deviation.max())

    def again(self, at: _State, jacobian: TorqueJacobian) -> _State:
        """Go on from these weights with these samples."""
        self.take(jacobian)
        return replace(at, residuals=jacobian.squares(at.x))

    def believe(self, prior: GaussianPrior) -> None:
        """Go on with this prior."""
        self.prior = prior
        self.precision = torch.linalg.inv(covariance(prior, self.jacobian.weights))

    @property
    def free(self) -> torch.Tensor:
        """Which weights (K,) move."""
        return self.jacobian.free(self.adapt, self.compensated)

    def settled(self) -> tuple[_State, torch.Tensor]:
        """As `solve`, all rounds from the start; the more probable of two ways where the first leaves much.

        Bodies that are far off leave much of the torque, which is taken for noise, and noise asks for no better bodies:
        on the second way there is little noise until the fit is near.
        """
        little = ALIKE**0.5 * FIRST_NOISE * self.range
        ways = []
        for most in (None, little):
            at, noise = self.solve(*self.near(little, most), ROUNDS - FIRST_ROUNDS)
            ways.append(
                (self.evidence(at.x, noise), at, noise, self.prior, self.covariance.clone(), self.compensated)
            )
            if (noise <= little).all():
                break
        _, at, noise, prior, self.covariance, self.compensated = max(ways, key=lambda way: way[0])
        self.believe(prior)
        return at, noise

    def evidence(self, x: torch.Tensor, noise: torch.Tensor) -> float:
        """The logarithm of the samples' marginal likelihood by Laplace's approximation, but for a constant."""
        free, away = self.free, x - self.start
        prior, posterior = self.precision[free][:, free], self.covariance[free][:, free]
        missed = self.count / ALIKE * noise.log().sum() + away @ self.precision @ away / 2
        return float((prior.logdet() + posterior.logdet()) / 2 - missed)

    def near(self, noise: torch.Tensor, most: torch.Tensor | None) -> tuple[_State, torch.Tensor]:
        """As `solve`, some rounds from the start; from there anew while further joints want a compensation, for what
        a fit made of their torque without one leads astray.
        """
        start = _State(self.start, self.jacobian.squares(self.start), float("inf"), DAMPING.first)
        while True:
            self.believe(self.guess)
            at, found = self.solve(start, noise, FIRST_ROUNDS, most)
            if self.adapt is not None or not self.compensate(at.x):
                return at, found
            start = replace(start, steps=at.steps)

    def compensate(self, x: torch.Tensor) -> bool:
        """Give a compensation to further joints that want one; whether there are such.

        No friction explains a torque that falls with velocity: a drive that compensates friction by itself, after
        its torque was measured, does.
        """
        slope, explained, size = self.jacobian.by_velocity(x)
        sure = explained * self.count / ALIKE > SIGNIFICANT**2 * (1 - explained)
        falls = (slope < 0) & (explained > COMPENSATED) & (size > VISIBLE * self.range)
        found = falls & sure & ~self.compensated
        self.compensated = self.compensated | found
        return bool(found.any())

    def solve(
        self, at: _State, noise: torch.Tensor, rounds: int, most: torch.Tensor | None = None
    ) -> tuple[_State, torch.Tensor]:
        """Steps down, and the noise (n,) after them; after each round it is found anew, as the prior is.

        There are more rounds while much is gained. most: of the noise, where the start may be far off: torques that are
        not explained yet are no noise.
        """
        for number in range(LONGER * rounds):
            self.weights = 1 / noise.square()
            at = replace(at, cost=self.cost(at.x, at.residuals), converged=False)
            *_, at = at, *levenberg_marquardt(self, at, max_steps=STEPS, relative_gain=GAIN)
            before, noise = noise, self.noise(at.residuals)
            noise = noise if most is None else torch.minimum(noise, most)
            self.covariance[self.free[:, None] & self.free] = torch.linalg.inv(self.curvature).flatten()
            if self.adapt != "load":
                weights, variance = self.jacobian.weights, self.covariance.diagonal()
                self.believe(most_probable(self.prior, self.guess, weights, at.x - self.start, variance))
            if number + 1 >= rounds and (noise > ENDED * before).all():
                break
        return at, noise

    def residuals(self, x: torch.Tensor) -> torch.Tensor:
        """Sums of squares of the torque that is missed (n,)."""
        return self.jacobian.squares(x)

    def cost(self, x: torch.Tensor, residuals: torch.Tensor) -> float:
        """See the top of this file."""
        away = x - self.start
        return float(((residuals * self.weights).sum() + away @ self.precision @ away) / 2)

    def normal_equations(self, x: torch.Tensor, residuals: torch.Tensor) -> NormalEquations:
        """By the weights that move."""
        free = self.free
        curvature, descent = self.jacobian.normal_equations(x, self.weights.rsqrt(), free)
        away = self.precision @ (x - self.start)
        self.curvature = curvature + self.precision[free][:, free]
        return NormalEquations(self.curvature, descent - away[free])

    def moved(self, x: torch.Tensor, step: torch.Tensor) -> Iterator[torch.Tensor]:
        """Straight in the weights, or in the bodies' parameters."""
        change = torch.zeros_like(x).masked_scatter(self.free, step)
        yield x + change
        yield self.jacobian.moved(x, change)

    def noise(self, squares: torch.Tensor) -> torch.Tensor:
        """Standard deviations (n,) of errors as if they were independent from sample to sample."""
        return ALIKE**0.5 * torch.maximum((squares / self.count).sqrt(), LEAST_NOISE * self.range)
