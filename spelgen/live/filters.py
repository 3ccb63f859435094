"""Kalman filters of the momentum balance over blocks: y = Phi theta + f a + b + d + w per joint.

theta (10): payload, constant. a (n): friction scale minus one, a random walk. b (n): torque offset, constant. d (n):
disturbance, an Ornstein-Uhlenbeck process. w: white noise. The rows of a block are used one after the other, so that
a control loop can spread them over its samples.
"""

from __future__ import annotations

import numpy as np

from spelgen.live.blocks import Block
from spelgen.live.noise import BlockNoise
from spelgen.live.payload import LOAD_PRIOR
from spelgen.live.tuning import TUNING


def huber(squared: float, variance: float) -> float:
    """Return the variance for a residual: `variance` of the model, increased for an outlier; squared: residual^2."""
    return max(variance, squared / TUNING.outlier**2)


class LoadFilter:
    """Filter of theta, a, b and d, in this order.

    x: (10 + 3 n,). P: its covariance. log_likelihood: of the rows since its last reset. surprise: sum of the
    normalised squared residuals of moving joints in the last block. factor: multiplies the standard deviation of the
    disturbance.
    """

    def __init__(self, noise: BlockNoise, effort: np.ndarray, factor: float = 1.0) -> None:
        n = len(effort)
        self.n, self.noise = n, noise
        self.disturbance = TUNING.variance * np.square(factor * noise.disturbance)
        self.x = np.zeros(10 + 3 * n)
        offset = np.square(TUNING.offset * effort)
        friction = np.full(n, TUNING.friction**2)
        self.P = np.diag(np.concatenate([np.square(LOAD_PRIOR), friction, offset, self.disturbance]))
        self.log_likelihood = self.surprise = 0.0

    def forget_load(self) -> None:
        """Reset the payload to its prior distribution."""
        self.x[:10] = 0.0
        self.P[:10] = self.P[:, :10] = 0.0
        self.P[range(10), range(10)] = np.square(LOAD_PRIOR)

    def predict(self, duration: float) -> None:
        """Advance the state by a time [s]."""
        n = self.n
        decay = np.exp(-duration / self.noise.time_constant)
        d = slice(10 + 2 * n, None)
        self.x[d] *= decay
        self.P[d] *= decay[:, None]
        self.P[:, d] *= decay
        diagonal = np.arange(10 + 2 * n, 10 + 3 * n)
        self.P[diagonal, diagonal] += (1 - decay**2) * self.disturbance
        self.P[range(10, 10 + n), range(10, 10 + n)] += TUNING.friction_walk * duration
        self.surprise = 0.0

    def update(self, block: Block, joint: int) -> None:
        """Update the state with the row of a joint; a joint at rest updates only its disturbance."""
        n = self.n
        columns = np.array([*range(10), 10 + joint, 10 + n + joint, 10 + 2 * n + joint])
        row = np.array([*block.load[joint], block.friction[joint], 1.0, 1.0])
        covariance = self.P[:, columns] @ row
        noise = TUNING.variance * self.noise.white[joint] ** 2
        noise += TUNING.uncertainty * block.uncertainty[joint] ** 2
        expected = float(row @ covariance[columns]) + noise
        residual = float(block.y[joint] - self.x[columns] @ row)
        variance = huber(residual**2, expected)
        gain = covariance / variance
        if not block.moving[joint]:
            gain[: 10 + 2 * n + joint] = gain[10 + 2 * n + joint + 1 :] = 0.0
        else:
            self.surprise += residual**2 / expected
        self.x += gain * residual
        # Joseph's form: valid for a gain that is not the optimal one
        product = np.outer(gain, covariance)
        self.P += variance * np.outer(gain, gain) - product - product.T
        self.log_likelihood -= 0.5 * (np.log(variance) + residual**2 / variance)


class DriftFilter:
    """Independent filters of a and d of each joint, for the reported payload.

    a, d: (n,). P: covariance of (a, d): aa, ad, dd, (3, n).
    """

    def __init__(self, noise: BlockNoise) -> None:
        self.noise = noise
        self.a, self.d = np.zeros((2, len(noise.white)))
        self.disturbance = TUNING.variance * np.square(noise.disturbance)
        self.P = np.stack([np.full_like(self.a, TUNING.friction**2), np.zeros_like(self.a), self.disturbance])

    def update(self, block: Block, theta: np.ndarray) -> None:
        """Predict the state over a block, and update it with the block; theta: payload, (10,)."""
        decay = np.exp(-block.duration / self.noise.time_constant)
        aa = self.P[0] + TUNING.friction_walk * block.duration
        ad = self.P[1] * decay
        dd = self.P[2] * decay**2 + (1 - decay**2) * self.disturbance
        self.d = self.d * decay
        f = block.friction
        residual = block.y - block.load @ theta - f * self.a - self.d
        by_a, by_d = f * aa + ad, f * ad + dd
        noise = TUNING.variance * self.noise.white**2 + TUNING.uncertainty * block.uncertainty**2
        variance = np.maximum(f * by_a + by_d + noise, residual**2 / TUNING.outlier**2)
        gain_a, gain_d = np.where(block.moving, by_a / variance, 0.0), by_d / variance
        self.a = self.a + gain_a * residual
        self.d = self.d + gain_d * residual
        self.P = np.stack([
            aa - 2 * gain_a * by_a + variance * gain_a**2,
            ad - gain_a * by_d - gain_d * by_a + variance * gain_a * gain_d,
            dd - 2 * gain_d * by_d + variance * gain_d**2,
        ])  # fmt: skip

    def ahead(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Return friction scale minus one and the disturbance, (n,) each, predicted for a time from now [s]."""
        if seconds > TUNING.disturbance_ahead:
            return self.a, np.zeros_like(self.d)
        return self.a, self.d * np.exp(-seconds / self.noise.time_constant)
