"""Constants of the solvers and of fits to windows."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DampingTuning:
    """Damping of Gauss-Newton steps, relative to the curvature's diagonal (`fitting.levenberg_marquardt`)."""

    first: float = 1e-3  # [1] before the first step (Marquardt, J. SIAM 11:431, 1963: 1e-2)
    least: float = 1e-9  # [1] smallest damping: below it steps are those of Gauss-Newton to nine digits
    # [1] by which damping falls after a step that gains, and rises otherwise (Marquardt: 10)
    factor: float = 10.0
    tries: int = 15  # dampings tried for one step: from the least to 1e6, where steps are next to nothing
    least_promise: float = 1e-10  # [1] of the cost: a step that promises less is rounding, and is not tried
    # [1] of what a step promises: one that keeps less is tried along the second way, too
    kept_promise: float = 0.5


@dataclass(frozen=True)
class ValidationTuning:
    """Windows that a fit is judged on (`fitting.dataset`)."""

    windows: int = 2048  # at most: validation is a measurement, it needs no more
    probe: int = 64  # training windows on which the integrator's error is watched
    chunks: int = 16  # of logs larger than memory, which windows are taken from


@dataclass(frozen=True)
class WindowTuning:
    """Steps on windows (`fitting.window.momentum`)."""

    epoch_steps: int = 20  # at least; few windows are passed over several times between validations
    warm_up: float = 0.02  # [1] of all steps, over which the learning rate rises
    final_rate: float = 0.01  # [1] of the learning rate, where its cosine ends
    momentum_fraction: float = 0.5  # [1] of the allowed time that the momentum steps may take
    momentum_factor: float = 10.0  # [1] on the learning rate of the momentum steps, which are cheap and noisy


@dataclass(frozen=True)
class LoopTuning:
    """Epochs of predicted windows (`fitting.window.rollout`)."""

    first_stage: float = 0.8  # [1] of all steps or minutes, at most, while residuals of rigid bodies rest
    second_patience: int = 3  # epochs: residuals that belong to the arm soon help
    probe_every: int = 5  # epochs: friction that is learned may be too stiff for the substeps so far
    rollbacks: int = 8  # attempts at half the learning rate each, before a fit is given up


@dataclass(frozen=True)
class IntegrationTuning:
    """Steps of the integrator in rollouts (`fitting.rollout`)."""

    most_substeps: int = 32  # of rk4 between samples
    fraction: float = 0.03  # [1] of the model's own error, that the integrator may add
    least_error: float = 1e-2  # [1] in units of the loss's scales: no model is expected to be better


@dataclass(frozen=True)
class AdaptiveTuning:
    """Rollouts by dopri5 (`fitting.rollout`)."""

    relative: float = 1e-7  # [1] tolerance of a step
    absolute: float = 1e-9  # [rad, m, and momenta] tolerance of a step


@dataclass(frozen=True)
class OptimizerTuning:
    """Optimizers of networks (`fitting.optimizers`)."""

    number_factor: float = 5.0  # [1] on the learning rate of constants and biases
    gradient_norm: float = 1.0  # of the scaled loss; larger gradients are shortened to it
    history: int = 50  # steps that L-BFGS remembers
    call: int = 20  # evaluations between looks at whether more would help
    stalled: float = 1 - 1e-3  # [1] of the loss before a call: what ends above it gained next to nothing
    too_large: float = 1e12  # given to the line search where a loss is not finite, so that it turns back


@dataclass(frozen=True)
class RegularizerTuning:
    """The regularizer towards the URDF (`fitting.urdf_regularizer`)."""

    points: int = 200  # positions at which M and gravity are compared
    widened: float = 0.5  # [1] of the logs' range, to both sides: a model is used a little beyond its logs
    least_scale: float = 0.05  # [1] of the largest gravity torque, for joints that gravity hardly loads
