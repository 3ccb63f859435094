"""Kalman filters of payload and friction drift, with the momentum balance as measurement equation.

The balance is averaged over blocks of time. Per joint it is y = Phi theta + f a + b + d + w:

- y: torque residual, the measured torque minus the torque of the model.
- Phi, theta: regressor and constant inertial parameters of the payload, (10,) each.
- f, a: friction torque of the model, and friction scale minus one; a is a random walk.
- b: constant torque offset.
- d: disturbance, an Ornstein-Uhlenbeck process.
- w: white noise.

The equations of the joints are processed one after the other, so that a control loop can distribute the computation
over several samples.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from spelgen.live.momentum import Balance
from spelgen.live.noise import BlockNoise, NoiseLevels
from spelgen.live.tuning import TUNING


class Block(NamedTuple):
    """Means of the terms of the momentum balance over a block of consecutive samples: one measurement of the filters.

    Attributes:
        duration: Length of the block [s].
        y: Torque residual of the model without payload, (n,) [Nm, N].
        load: Regressor Phi of the payload, (n, 10).
        friction: Friction torque of the model, (n,) [Nm, N].
        uncertainty: Half of the difference between the largest and the smallest friction torque that an unknown
            friction state permits, (n,) [Nm, N].
        moving: True for joints that moved, (n,).
    """

    duration: float
    y: np.ndarray
    load: np.ndarray
    friction: np.ndarray
    uncertainty: np.ndarray
    moving: np.ndarray

    def joined(self, later: Block) -> Block:
        """Return this block and the next block, `later`, as one block.

        The duration of the joined block is the sum of both durations. Its torque residual, regressor, friction and
        uncertainty are means over the whole time. A joint counts as moving only if it moved in both blocks.
        """
        duration = self.duration + later.duration
        # The terms of a block are means over time: the means over both blocks are weighted by their durations.
        weight = later.duration / duration
        means = [a + weight * (b - a) for a, b in zip(self[1:5], later[1:5], strict=True)]
        y, load, friction, uncertainty = means
        return Block(duration, y, load, friction, uncertainty, self.moving & later.moving)


class Blocks:
    """Accumulator of samples, which returns their means as a `Block` every `TUNING.block` seconds.

    rest_speed: speed below which a joint is at rest, (n,) [rad/s, m/s].
    """

    def __init__(self, rest_speed: np.ndarray) -> None:
        self.rest_speed = rest_speed
        self.restart()

    def restart(self) -> None:
        """Discard the samples of the incomplete block, for example after a gap."""
        self.samples: list[tuple[float, Balance]] = []
        self.duration = 0.0

    def add(self, t: float, at: Balance) -> Block | None:
        """Add a sample at time t [s] with its terms of the momentum balance; return the block if it is complete."""
        step = t - self.samples[-1][0] if self.samples else 0.0
        self.samples.append((t, at))
        # The duration of a block is a sum of time steps, because the exported C code computes it in this way. The
        # difference of the last and the first time would have other rounding errors.
        self.duration += step
        # The block ends at the sample at which its duration is nearest to `TUNING.block`.
        if len(self.samples) == 1 or self.duration < TUNING.block - step / 2:
            return None
        times, terms = zip(*self.samples, strict=True)
        duration, first, last = self.duration, terms[0], terms[-1]
        # Blocks are contiguous: the last sample of a block is the first one of the next block.
        self.samples, self.duration = self.samples[-1:], 0.0
        means = [np.trapezoid(np.array(term), times, axis=0) / duration for term in zip(*terms, strict=True)]
        _, torque, friction, uncertainty, _, load_torque, *_ = means
        load = (last.load_momentum - first.load_momentum) / duration - load_torque
        y = torque - friction - (last.momentum - first.momentum) / duration
        fastest = np.abs([term.velocity for term in terms[1:]]).max(axis=0)
        return Block(duration, y, load, friction, uncertainty, fastest > self.rest_speed)


class LoadFilter:
    """Kalman filter of the payload's parameters theta, and of friction change a, offset b and disturbance d per joint.

    The measurement equation and its symbols are in the docstring of the module.

    Args:
        noise: standard deviations of the white noise w and of d, and time constant of d.
        effort: torque limits, which scale the prior of b, (n,) [Nm, N].

    Attributes:
        x: State (theta, a, b, d), (10 + 3 n,).
        P: Covariance of x, (10 + 3 n, 10 + 3 n).
        log_likelihood: Log likelihood of all measurements since this attribute was last reset to zero.
        surprise: Sum of the normalised squared residuals of moving joints in the last block.
        disturbance: Stationary variance of d, (n,).
    """

    def __init__(self, noise: BlockNoise, effort: np.ndarray) -> None:
        self.n, self.noise = len(effort), noise
        self.disturbance = np.square(noise.disturbance)
        self.x = np.zeros(10 + 3 * self.n)
        offset, friction = np.square(TUNING.offset * effort), np.full(self.n, TUNING.friction**2)
        self.P = np.diag(np.concatenate([np.square(TUNING.load_prior), friction, offset, self.disturbance]))
        self.log_likelihood = self.surprise = 0.0

    def forget_load(self) -> None:
        """Reset the payload's parameters theta to their prior distribution, for a new payload."""
        self.x[:10] = 0.0
        self.P[:10] = self.P[:, :10] = 0.0
        self.P[:10, :10] = np.diag(np.square(TUNING.load_prior))

    def predict(self, duration: float) -> None:
        """Replace the state x and its covariance P by their prediction after a time `duration` [s]."""
        decay, growth = np.ones_like(self.x), np.zeros_like(self.x)
        decay[-self.n :] = np.exp(-duration / self.noise.time_constant)
        growth[10 : 10 + self.n] = TUNING.friction_walk * duration
        growth[-self.n :] = (1 - decay[-self.n :] ** 2) * self.disturbance
        self.x *= decay
        self.P = self.P * np.outer(decay, decay) + np.diag(growth)
        self.surprise = 0.0

    def update(self, block: Block, joint: int) -> None:
        """Update the state with the torque residual y (`block.y`) of one joint.

        A joint at rest updates only its disturbance d, since friction at standstill is unknown.

        block: means over a block of samples. joint: index of the joint.
        """
        columns = [*range(10), *range(10 + joint, 10 + 3 * self.n, self.n)]
        row = np.array([*block.load[joint], block.friction[joint], 1.0, 1.0])
        covariance = self.P[:, columns] @ row
        noise = self.noise.white[joint] ** 2 + TUNING.uncertainty * block.uncertainty[joint] ** 2
        noise += TUNING.load_error**2 * block.y[joint] ** 2
        expected = float(row @ covariance[columns]) + noise
        residual = float(block.y[joint] - self.x[columns] @ row)
        # The influence of an outlier is bounded by a larger variance, which corresponds to Huber's weights.
        variance = max(expected, residual**2 / TUNING.outlier**2)
        # The factors are multiplied in the same order as in the exported C code, so that rounding errors are equal.
        weight = 1 / variance
        gain = covariance * weight
        if block.moving[joint]:
            self.surprise += residual**2 / expected
            self.x += gain * residual
            # This outer product is exactly symmetric; the product of gain and covariance would be so only up to
            # rounding errors, and the resulting asymmetry of P would grow with each update.
            product = np.outer(covariance, covariance) * weight
            recurring = TUNING.recurring * (noise + self.disturbance[joint])
            kept = recurring / max(float(row[:10] @ self.P[:10, :10] @ row[:10]), recurring)
            self.P -= product
            self.P[:10, :10] += kept * product[:10, :10]
        else:
            # A joint at rest updates only its disturbance d: the Kalman gains of all other states are set to zero. Such
            # a gain is not optimal, so the covariance is updated by Joseph's form, which is valid for any gain.
            d, product = columns[-1], gain[columns[-1]] * covariance
            self.x[d] += gain[d] * residual
            self.P[d] -= product
            self.P[:, d] -= product
            self.P[d, d] += variance * gain[d] ** 2
        self.log_likelihood -= 0.5 * (np.log(variance) + residual**2 / variance)


class JointFilters:
    """Independent Kalman filters of friction change a and disturbance d of each joint, for a known payload.

    The friction torque is 1 + a times the friction torque of the model. Each filter has K states: (a, d), or (a, b, d)
    with a torque offset b. Filters with different noise can be computed at once, along the leading axes (...) of all
    arrays.

    Attributes:
        x: states, (..., n, K).
        P: covariances, (..., n, K, K).
    """

    def __init__(
        self, deviations: np.ndarray, white: np.ndarray, time_constant: np.ndarray, *, drifts: bool = False
    ) -> None:
        """Initialize all states to zero: friction as in the model, no torque offset and no disturbance.

        Args:
            deviations: prior standard deviations of the K states, (..., n, K): friction change a [1], torque offset b
                if K = 3 [Nm, N], disturbance d [Nm, N]. The value for d is also the stationary standard deviation of d.
            white: standard deviations of the white noise of the torque residual, (..., n) [Nm, N].
            time_constant: time constant of d, (..., n) [s].
            drifts: True: a is a random walk, and joints at rest update d. False: a is constant, and joints at rest
                update no state.
        """
        self.x, self.P = np.zeros_like(deviations), deviations[..., None] ** 2 * np.eye(deviations.shape[-1])
        self.disturbance, self.white, self.time_constant = deviations[..., -1] ** 2, white**2, time_constant
        self.drifts = drifts

    @classmethod
    def of_drift(cls, noise: BlockNoise) -> JointFilters:
        """Return the estimator's drift filters with two states: friction change a (a random walk) and disturbance d.

        noise: noise of the torque residual of blocks of the drift filter.
        """
        deviations = np.stack([np.full_like(noise.white, TUNING.friction), noise.disturbance], axis=-1)
        return cls(deviations, noise.white, noise.time_constant, drifts=True)

    def update(self, block: Block, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict the states to a block of samples, and update them with the torque residual of the block.

        Args:
            block: Means of the terms of the momentum balance.
            torque: Torque residual of the block minus the torque of the payload, (n,) [Nm, N].

        Returns:
            Prediction error (`torque` minus its prediction) [Nm, N], and its predicted variance, (..., n) each. The
            leading axes (...) are the filters with different noise.
        """
        decay = np.ones_like(self.x)
        decay[..., -1] = np.exp(-block.duration / self.time_constant)
        self.x = self.x * decay
        self.P = self.P * decay[..., None] * decay[..., None, :]
        self.P[..., 0, 0] += self.drifts * TUNING.friction_walk * block.duration
        self.P[..., -1, -1] += (1 - decay[..., -1] ** 2) * self.disturbance
        row = np.ones_like(self.x)
        row[..., 0] = block.friction
        covariance = (self.P @ row[..., None])[..., 0]
        expected = (row * covariance).sum(axis=-1) + self.white + TUNING.uncertainty * block.uncertainty**2
        residual = torque - (row * self.x).sum(axis=-1)
        variance = np.maximum(expected, residual**2 / TUNING.outlier**2)
        used = np.repeat(block.moving[:, None], self.x.shape[-1], axis=1)
        used[:, -1] |= self.drifts
        gain = np.where(used, covariance / variance[..., None], 0.0)
        self.x = self.x + gain * residual[..., None]
        # Only the states in `used` are updated: their gain is the Kalman gain, and the gain of the other states is zero
        # (Schmidt-Kalman filter). Joseph's form of the covariance update is then simple: P_ij is reduced by c_i c_j /
        # variance if at least one of the states i and j is used, otherwise it is unchanged. c is the covariance of the
        # states with the measurement.
        product = covariance[..., None] * covariance[..., None, :] / variance[..., None, None]
        self.P = self.P - np.where(used[..., None] | used[..., None, :], product, 0.0)
        return residual, expected


class PayloadEstimate:
    """The payload filter, with detection of a changed payload.

    After a block with large residuals there are two copies of the filter: one for the hypothesis that the payload has
    changed, one for the hypothesis of a contact. The copies exist until the change of the payload is accepted or both
    hypotheses are dropped. A block has one filter update per joint and filter. The updates are distributed over the
    samples of the next block, to limit the computing time per sample.

    Attributes:
        filters: the filter without a hypothesis, then the two copies, if any.
        moved: time in motion since the first sample or the last change of the payload [s].
        changed: True if a change of the payload was accepted, until the caller sets it to False.
        misfit: mean of the normalised squared residuals of moving joints in about the last second [1].
    """

    def __init__(self, levels: NoiseLevels) -> None:
        self.filters = [LoadFilter(levels.load, levels.effort)]
        self.rows: Iterator[None] = iter(())
        self.moved = self.hypotheses_moved = 0.0
        self.changed, self.misfit = False, 1.0
        self.samples = self.per_sample = 0

    def start(self, block: Block) -> None:
        """Finish the filter updates of the previous block, and prepare the updates of `block` for calls of `step`."""
        for _ in self.rows:
            pass
        if block.moving.any():
            self.moved += block.duration
            self.hypotheses_moved += block.duration
        self.per_sample = -(-len(self.filters) * len(block.y) // max(self.samples - 1, 1))
        self.samples = 0
        self.rows = self._rows(block)

    def step(self) -> None:
        """Process some filter updates of the current block; the method is called at each sample.

        The number of updates per call is chosen so that all updates of a block are finished before the next block is
        complete.
        """
        self.samples += 1
        for _ in range(self.per_sample):
            next(self.rows, None)

    def _rows(self, block: Block) -> Iterator[None]:
        for each in self.filters:
            each.predict(block.duration)
        rows = list(itertools.product(self.filters, range(len(block.y))))
        for number, (each, joint) in enumerate(rows, start=1):
            each.update(block, joint)
            if number == len(rows):
                self._compare(int(block.moving.sum()))
            yield

    def _compare(self, moving: int) -> None:
        """Update the detection of a changed payload after all filter updates of a block of samples.

        If the hypotheses of a changed payload and of a contact exist, accept the change or drop both hypotheses.
        Otherwise start both if the squared torque residuals of the block are much larger than expected.

        moving: number of joints that moved in the block.
        """
        main = self.filters[0]
        if moving:
            self.misfit += 2 * TUNING.block / TUNING.report * (main.surprise / moving - self.misfit)
        if len(self.filters) > 1:
            _, candidate, contact = self.filters
            ratio = candidate.log_likelihood - max(main.log_likelihood, contact.log_likelihood)
            if self.hypotheses_moved >= TUNING.changed_after and ratio > TUNING.changed:
                self.filters, self.changed, self.moved = [candidate], True, self.hypotheses_moved
                self.misfit = 1.0
                return
            least = TUNING.changed_after if ratio < TUNING.unlikely else TUNING.dropped_after
            if self.hypotheses_moved >= least:
                self.filters = [main]
        is_surprise = moving and main.surprise > moving + TUNING.surprise * math.sqrt(2 * moving)
        # Hypotheses are not started in the first second of motion, in which residuals are large because the payload is
        # unknown.
        if len(self.filters) == 1 and is_surprise and self.moved >= TUNING.changed_after:
            main.log_likelihood = self.hypotheses_moved = 0.0
            candidate, contact = copy.deepcopy(main), copy.deepcopy(main)
            candidate.forget_load()
            variance = np.maximum(main.disturbance, np.square(main.noise.white))
            contact.disturbance = variance * TUNING.contact_disturbance**2
            self.filters = [main, candidate, contact]
