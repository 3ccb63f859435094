"""Constants of the solvers and of fits to windows."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FittingTuning:
    """Constants of the solvers and of fits to windows, by the file that reads them."""

    # Damping of Gauss-Newton steps, relative to the diagonal of the curvature (`fitting.levenberg_marquardt`).

    # [1] Damping of the first step (Marquardt, J. SIAM 11:431, 1963: 1e-2).
    initial_damping: float = 1e-3
    # [1] Smallest damping: below it steps equal Gauss-Newton steps to nine digits.
    min_damping: float = 1e-9
    # [1] Factor by which the damping is lowered after a step that decreases the cost, and raised otherwise
    # (Marquardt: 10).
    damping_factor: float = 10.0
    # [1] Dampings tried for one step: from the smallest to 1e6, at which steps are negligible.
    max_trials: int = 15
    # [1] Predicted reduction of the cost, as a fraction of the cost, below which a step is not tried: rounding errors.
    min_predicted_decrease: float = 1e-10
    # [1] Gain ratio (decrease divided by predicted reduction) below which the next candidate of a step is evaluated,
    # too.
    min_gain_ratio: float = 0.5

    # Windows on which a fit is validated (`fitting.dataset`).

    # [1] Largest number of validation windows: validation is a measurement and needs no more.
    validation_windows: int = 2048
    # [1] Training windows on which the integration error is monitored.
    probe_windows: int = 64

    # Steps on windows (`fitting.momentum_objective`).

    # [1] Smallest number of steps per epoch; few windows are passed several times between validations.
    epoch_steps: int = 20
    # [1] Fraction of all steps over which the learning rate rises.
    warm_up: float = 0.02
    # [1] Final value of the cosine schedule, as a fraction of the learning rate.
    final_rate: float = 0.01
    # [1] Fraction of the allowed time that momentum steps may take.
    momentum_fraction: float = 0.5
    # [1] Factor on the learning rate of momentum steps, which are cheap and noisy.
    momentum_factor: float = 10.0

    # Epochs of predicted windows (`fitting.rollout_objective`).

    # [1] Largest fraction of all steps or minutes during which residual terms of rigid bodies are constant.
    first_stage: float = 0.8
    # [1] Epochs without improvement in the second stage: residual terms that belong to the arm improve the loss soon.
    second_patience: int = 3
    # [1] Epochs between choices of the integration step: trained friction may have become too stiff for it.
    probe_every: int = 5
    # [1] Attempts at half the learning rate each, before a fit is abandoned.
    max_rollbacks: int = 8

    # Integration step of rollouts (`fitting.rollout`).

    # [1] Largest number of rk4 steps between samples.
    max_substeps: int = 32
    # [1] Allowed integration error, as a fraction of the model's error.
    integration_fraction: float = 0.03
    # [1] Smallest expected error of a model, in units of the loss's scales.
    min_model_error: float = 1e-2

    # Rollouts by dopri5 (`fitting.rollout`).

    # [1] Relative tolerance of a step.
    adaptive_rtol: float = 1e-7
    # [rad, m, and momenta] Absolute tolerance of a step.
    adaptive_atol: float = 1e-9

    # Optimizers of networks (`fitting.optimizers`).

    # [1] Factor on the learning rate of constants and biases.
    number_factor: float = 5.0
    # [1] Largest norm of the gradient of the scaled loss; larger gradients are scaled down to it.
    gradient_norm: float = 1.0
    # [1] Steps from which L-BFGS approximates the curvature.
    lbfgs_history: int = 50
    # [1] Evaluations of the loss between tests of convergence.
    lbfgs_call: int = 20
    # [1] A call of L-BFGS that ends above this fraction of the previous loss has made no progress.
    lbfgs_stalled: float = 1 - 1e-3
    # [1] Value of a loss that is not finite, so that the line search reverses.
    too_large: float = 1e12

    # Regularizer towards the URDF (`fitting.urdf_regularizer`).

    # [1] Random positions at which M and gravity are compared.
    regularizer_points: int = 200
    # [1] Margin on both sides of the range of the logs, as a fraction of it: a model is used slightly outside its
    # logs.
    regularizer_margin: float = 0.5
    # [1] Smallest scale of the gravity torque of a joint, as a fraction of the largest joint.
    min_gravity_scale: float = 0.05


TUNING = FittingTuning()
