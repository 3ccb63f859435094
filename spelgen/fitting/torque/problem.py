"""The cost of rigid bodies that are fitted to torques, and how its noise and prior are found.

The torque is linear in the bodies' parameters, which the log-Cholesky weights make possible ones, and smooth in the
few constants of each joint: seconds are enough, and no step size is to be chosen. What is minimised is

    sum over joints and samples of (missing torque / noise)^2 + (weights - start)^T covariance^-1 (weights - start),

half of it, with the covariance of a Gaussian prior (see ``covariance``). Where gains between logged and joint torques
are trained, what is missed is in the logged ones, else all torques would shrink with their gains. The noise of a joint
is what least squares leave of its torque, and then what the fit leaves, found in rounds, as is how far the start is to
be trusted (see ``most_probable``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch

from spelgen.fitting.levenberg_marquardt import NormalEquations, SolverState, levenberg_marquardt, start
from spelgen.fitting.torque.jacobian import (
    NO_FUNCTIONS,
    TUNING,
    FollowingFunctions,
    ResidualSamples,
    RigidResponse,
    TorqueJacobian,
)
from spelgen.fitting.torque.prior import ADAPTED, covariance, most_probable
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.weights import NONE
from spelgen.settings.fits import Adaptation, GaussianPrior

State = SolverState[torch.Tensor]
"""Weights (K,); as residuals the sums of squares of the torque that they miss (n,)."""


EFFECTS = ("effects", "load_dependence")
"""Kinds of what varies friction, which not every joint has."""

Snapshot = tuple[torch.Tensor, torch.Tensor, GaussianPrior, torch.Tensor]


class TorqueProblem:
    """The cost of weights (K,) under a noise and a prior, which rounds of steps find anew: a `LeastSquares`.

    compensated: (n,) joints whose drives compensate friction unseen. covariance: of the weights, as last found.
    noise: (n,) standard deviations of errors as if they were independent from sample to sample.
    """

    def __init__(self, jacobian: TorqueJacobian, prior: GaussianPrior, adapt: Adaptation | None) -> None:
        rigid = jacobian.rigid
        self.start, self.guess, self.adapt = rigid.flattened(rigid.start), prior, adapt
        self.compensated = rigid.start[rigid.compensation] != 0
        self.covariance = torch.zeros(len(self.start), len(self.start)).double()
        self.masks = {kind: rigid.mask(kind) for kind in ADAPTED}
        self._use(jacobian)
        self.set_prior(prior)

    def _use(self, jacobian: TorqueJacobian) -> None:
        self.jacobian, self.count = jacobian, jacobian.samples.count
        self.correlation = max(1.0, TUNING.correlation_length / jacobian.samples.step)
        self.lasting = max(1.0, TUNING.lasting_errors / jacobian.samples.step)
        deviation = jacobian.torque_deviation()
        self.range = torch.maximum(deviation, 1e-3 * deviation.max())

    def set_samples(self, state: State, jacobian: TorqueJacobian) -> State:
        """Go on from a state with other samples."""
        self._use(jacobian)
        return replace(state, residuals=jacobian.squares(state.x))

    def refine(
        self, state: State, samples: TorqueSamples, functions: Mapping[int, FollowingFunctions] = NO_FUNCTIONS
    ) -> State:
        """Go on from a fit near by with other samples, or beside other residuals: only the last digits are fitted."""
        state = self.set_samples(state, TorqueJacobian(self.jacobian.model, samples, functions))
        self.set_noise(state.residuals)
        return self.solve(state, TUNING.last_rounds)

    def set_prior(self, prior: GaussianPrior) -> None:
        """Go on with another prior."""
        self.prior = prior
        rigid = self.jacobian.rigid
        self.precision = torch.linalg.inv(covariance(prior, rigid.start, rigid.kinds))

    def set_noise(self, squares: torch.Tensor, determined: torch.Tensor | float = 0.0) -> None:
        """Take for noise what is missed: sums of squares (n,). This is the one place of the noise model.

        determined: how many weights each torque determines, (n,), of which each takes an independent error.
        """
        errors = self.count / self.correlation
        left = torch.as_tensor(1.0 - determined / errors).clamp(min=TUNING.least_left)
        rms = torch.maximum((squares / self.count / left).sqrt(), TUNING.least_noise * self.range)
        self.noise = self.correlation**0.5 * rms

    def _set_least_squares_noise(self, x: torch.Tensor) -> None:
        """Take for noise what least squares miss, which no prior holds; of torques that are linear about x (K,)."""
        self.noise = self.correlation**0.5 * self.range
        slopes = list(self.jacobian.slopes(x))
        for _ in range(TUNING.last_rounds):
            self.set_noise(*self.jacobian.least_squares(slopes, self.noise, self.free))

    def _first_fit(self, x: torch.Tensor, steps: int) -> State:
        """Return the end of all steps from weights x (K,), under the noise of least squares.

        Bodies that are far off leave much of the torque, which is taken for noise, and noise asks for no better bodies.
        """
        self._set_least_squares_noise(x)
        return self._steps(start(self, x, steps=steps), TUNING.first_steps)

    def _fit_from_start(self, steps: int) -> State:
        """Return the first fit from the start, where bodies may be far off.

        Under the noise of least squares these wind along a narrow valley: noise falls to it with what is missed.
        """
        self._set_least_squares_noise(self.start)
        least = self.noise
        state = start(self, self.start, steps=steps)
        for _ in range(TUNING.first_rounds):
            missed = (self.correlation * state.residuals / self.count).sqrt()
            self.noise = torch.maximum(least, TUNING.first_noise * missed)
            if (self.noise == least).all():
                break
            state = self._steps(state, TUNING.steps)
        return self._first_fit(state.x, state.steps)

    @property
    def free(self) -> torch.Tensor:
        """Which weights (K,) move."""
        return self.jacobian.rigid.free(self.adapt, self.compensated)

    def solve_from_start(self) -> State:
        """As `solve`, all rounds from the start; from there anew while further joints want a compensation, for what a
        fit made of their torque without one leads astray.
        """
        state = self._fit_from_start(0)
        while self.adapt is None and self._compensate(state.x):
            state = self._fit_from_start(state.steps)
        return self.solve(state, TUNING.rounds)

    def select_memory(self, state: State) -> State:
        """Go on from a fit without memory of friction; give bristles to the joints whose samples show memory.

        Bristles turn around after a displacement, and so late: where friction turns around at once, they pass for
        inertia. The gears of an arm are mostly alike: weak evidence of a joint yields to that of all.
        """
        laws, before = self.jacobian.model.friction, self.snapshot()
        laws.memoryless.fill_(0.0)
        remembering = self.solve(self._first_fit(state.x, state.steps), TUNING.rounds)
        evidence = self._evidence(remembering, state) - self._fractions_narrowed()
        laws.memoryless.copy_(_unlikely(evidence))
        if laws.memoryless.all():
            self.restore(before)
            return state
        if laws.memoryless.any():
            return self.solve(self.set_samples(remembering, self.jacobian), TUNING.rounds)
        return remembering

    def select_effects(self, state: State) -> State:
        """Go on without Stribeck effect, saturation and dependence on load of joints whose samples show none of them.

        They are positive, and so none is an error to one side, of all joints together.
        """
        rigid = self.jacobian.rigid
        places = rigid.named(torch.arange(len(self.start)))
        effects = torch.stack([places[name] for name in rigid.of_kind(*EFFECTS)], dim=-1)

        def without(joints: torch.Tensor) -> State:
            x, rows = state.x.clone(), effects[joints]
            self.start = self.start.clone()
            self.start[rows] = x[rows] = NONE
            return self.solve(replace(state, x=x, residuals=self.jacobian.squares(x)), TUNING.rounds)

        before = self.snapshot()
        plain = without(torch.ones(len(effects), dtype=torch.bool))
        unlikely = _unlikely(self._evidence(state, plain) - TUNING.effects_evidence)
        if unlikely.all():
            return plain
        self.restore(before)
        return without(unlikely) if unlikely.any() else state

    def _evidence(self, state: State, other: State) -> torch.Tensor:
        """Return how much more likely the samples of each joint (n,) are after a fit: twice the logarithm."""
        return self.count / self.lasting * (other.residuals / state.residuals).log()

    def snapshot(self) -> Snapshot:
        """Return what rounds have found, to be restored."""
        return self.start, self.noise, self.prior, self.covariance.clone()

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from what rounds had found before."""
        self.start, self.noise, prior, self.covariance = snapshot
        self.set_prior(prior)

    def _fractions_narrowed(self) -> torch.Tensor:
        """Return, of each joint (n,), by how much samples narrowed its bristles' fractions: logarithms of variances.

        Freedom explains noise, too: evidence is what a fit explains, less what it was narrowed (MacKay, 1992).
        """
        rigid = self.jacobian.rigid
        (fractions,) = rigid.of_kind("fractions")
        places = rigid.named(torch.arange(len(self.start)))[fractions]
        block = places.unsqueeze(-1), places.unsqueeze(-2)
        before: torch.Tensor = torch.linalg.inv(self.precision)[block]
        return before.logdet() - self.covariance[block].logdet()

    def around(self, state: State) -> tuple[ResidualSamples, RigidResponse]:
        """Return what bodies and laws miss after a fit, and how they would follow what else explained it."""
        self.normal_equations(state.x, state.residuals)
        self._set_covariance()  # under the noise of now: what followed too far would show a spring that is none
        response = self.jacobian.response(state.x, self.noise, self.covariance)
        return self.jacobian.residual_samples(state.x), response

    def _compensate(self, x: torch.Tensor) -> bool:
        """Give a compensation to further joints that want one; return whether there are such.

        No friction explains a torque that falls with velocity: a drive that compensates friction by itself, after
        its torque was measured, does.
        """
        samples = self.jacobian.residual_samples(x)
        products = (samples.missing * samples.qd).sum(dim=0)
        slope = products / samples.qd.square().sum(dim=0).clamp(min=1e-300)
        # of the sum of squares, what a line explains
        explained = slope * products / samples.missing.square().sum(dim=0).clamp(min=1e-300)
        count = self.count / self.correlation
        significant = explained * count > TUNING.compensation_deviations**2 * (1 - explained)
        # milliseconds between torque and motion look alike, but smaller
        visible = (slope * products / self.count).sqrt() > TUNING.compensation_visible * self.range
        falls = (slope < 0) & (explained > TUNING.compensation_explained) & visible
        further = falls & significant & ~self.compensated
        self.compensated = self.compensated | further
        return bool(further.any())

    def solve(self, state: State, rounds: int) -> State:
        """Take steps in rounds, after each of which noise and prior are found anew, while much is gained."""
        for number in range(TUNING.longer * rounds):
            state = self._steps(state, TUNING.steps)
            previous = self.noise
            self._set_covariance()
            self.set_noise(state.residuals, self._determined() / len(state.residuals))
            if self.adapt != "load":
                away = state.x - self.start
                self.set_prior(most_probable(self.prior, self.guess, self.masks, away, self.covariance))
            if number + 1 >= rounds and (self.noise > TUNING.noise_settled * previous).all():
                break
        return state

    def _determined(self) -> float:
        """Return how many weights all torques determine: those that move, less what is the prior's (MacKay, 1992)."""
        free = self.free
        return float(free.sum() - (self.covariance * self.precision)[free][:, free].sum())

    def _set_covariance(self) -> None:
        """Take the covariance from the curvature of the last normal equations."""
        free = self.free
        self.covariance[free[:, None] & free] = torch.linalg.inv(self.curvature).flatten()

    def _steps(self, state: State, most: int) -> State:
        """Take steps under the noise and prior of now."""
        state = replace(state, cost=self.cost(state.x, state.residuals), converged=False)
        for step in levenberg_marquardt(self, state, max_steps=most, relative_gain=TUNING.gain):
            state = step
        return state

    def residuals(self, x: torch.Tensor) -> torch.Tensor:
        """Return sums of squares of the torque that is missed (n,)."""
        return self.jacobian.squares(x)

    def cost(self, x: torch.Tensor, residuals: torch.Tensor) -> float:
        """Return what is minimised (see the top of this file)."""
        away = x - self.start
        return float(((residuals / self.noise.square()).sum() + away @ self.precision @ away) / 2)

    def normal_equations(self, x: torch.Tensor, residuals: torch.Tensor) -> NormalEquations:
        """Return them by the weights that move."""
        free = self.free
        curvature, descent = self.jacobian.normal_equations(x, self.noise)
        away = self.precision @ (x - self.start)
        self.curvature = (curvature + self.precision)[free][:, free]
        return NormalEquations(self.curvature, (descent - away)[free])

    def moved(self, x: torch.Tensor, step: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yield where a step leads, straight in the weights or in the bodies' parameters."""
        change = torch.zeros_like(x).masked_scatter(self.free, step)
        yield x + change
        yield self.jacobian.moved(x, change)


def _unlikely(evidence: torch.Tensor) -> torch.Tensor:
    """Return the joints (n,) whose evidence says no; weak evidence of a joint yields to that of all."""
    return evidence < -TUNING.strong_evidence * evidence.sum().sign()
