"""Constants of the solvers and of fits to windows."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FittingTuning:
    """Constants of the solvers and of fits to windows, grouped by the file that uses them."""

    # Constants of the damping of Gauss-Newton steps, relative to the diagonal of the curvature
    # (`fitting.levenberg_marquardt`).

    # [1] Damping of the first step. Marquardt (J. SIAM 11:431, 1963) uses 1e-2.
    initial_damping: float = 1e-3
    # [1] Smallest damping: steps with a smaller damping equal Gauss-Newton steps to nine digits.
    min_damping: float = 1e-9
    # [1] After a step that decreases the cost, the damping is divided by this number; after any other step, it is
    # multiplied by it (Marquardt: 10). The fits of single servo joints, of at most six steps, multiply by only half of
    # this number, 5: with a damping that is too large, the remaining steps would be too short.
    damping_factor: float = 10.0
    # [1] Largest number of dampings tried for one step. If the first is the smallest damping, the last is 1e5, with
    # which steps are negligible.
    max_trials: int = 15
    # [1] After a rejected step, the step with a larger damping is tried only if a component differs from the rejected
    # step by more than this fraction of the largest component: otherwise both steps are nearly equal.
    same_step: float = 1e-3
    # [1] Smallest predicted decrease of the cost for which a step is tried, as a fraction of the cost. Smaller
    # decreases are within rounding errors.
    min_predicted_decrease: float = 1e-10
    # [1] Gain ratio (decrease of the cost divided by its predicted decrease) below which the next point that the
    # problem proposes for a step (`candidates`) is evaluated, too.
    min_gain_ratio: float = 0.5

    # Constants of the windows on which a fit is validated (`fitting.dataset`).

    # [1] Largest number of validation windows: enough for the mean loss, which is computed after every epoch.
    validation_windows: int = 2048
    # [1] Number of training windows on which the integration error is measured.
    probe_windows: int = 64

    # Constants of optimizer steps on windows (`fitting.momentum_objective`).

    # [1] Smallest number of steps per epoch; if there are few windows, an epoch uses each window several times.
    epoch_steps: int = 20
    # [1] Fraction of all steps during which the learning rate rises linearly to its full value.
    warm_up: float = 0.02
    # [1] Learning rate at the end of the cosine schedule, as a fraction of the full learning rate.
    final_rate: float = 0.01
    # [1] Fraction of the time limit of a fit that steps on the loss of momenta (`momentum_loss`) may take.
    momentum_fraction: float = 0.5
    # [1] Learning rate of steps on `momentum_loss`, which are cheap and noisy, as a multiple of the configured learning
    # rate.
    momentum_factor: float = 10.0

    # Constants of fits to predicted motion in windows of the logs (`fitting.rollout_objective`).

    # [1] Largest fraction of all steps, or of the time limit, for the first stage. In the first stage, residual terms
    # that the torque fit did not select are fixed.
    first_stage: float = 0.8
    # [1] The second stage, in which all terms are free, ends after this number of epochs without improvement. Residual
    # terms that describe the arm lower the loss within few epochs.
    second_patience: int = 3
    # [1] Number of epochs after which the integration step is chosen again: the fitted friction may have become too
    # stiff for the present step.
    probe_every: int = 5
    # [1] Number of diverged epochs that are repeated, each at half the learning rate, before a fit ends with an error.
    max_rollbacks: int = 8

    # Constants of the integration step of rollouts (`fitting.rollout`).

    # [1] Largest number of rk4 steps per sample interval.
    max_substeps: int = 32
    # [1] Largest accepted integration error of a rollout, as a fraction of the model's prediction error.
    integration_fraction: float = 0.03
    # [1] The integration error is compared with the model's prediction error or with this value, whichever is larger;
    # both numbers are errors divided by the scales of the loss.
    min_model_error: float = 1e-2

    # Constants of rollouts by the adaptive solver dopri5 (`fitting.rollout`).

    # [1] Relative tolerance of a step of dopri5.
    adaptive_rtol: float = 1e-7
    # [rad, m, Nm s, N s] Absolute tolerance of a step of dopri5, for positions and momenta.
    adaptive_atol: float = 1e-9

    # Constants of the optimizers of networks (`fitting.optimizers`).

    # [1] Learning rate of constants and biases, as a multiple of the learning rate of matrices.
    number_factor: float = 5.0
    # [1] Largest norm of the gradient of the scaled loss; larger gradients are scaled down to this norm.
    gradient_norm: float = 1.0
    # [1] Number of past steps from which L-BFGS approximates the inverse Hessian.
    lbfgs_history: int = 50
    # [1] Number of evaluations of the loss between tests of convergence.
    lbfgs_call: int = 20
    # [1] A call of L-BFGS has made no progress if the loss at its end exceeds this fraction of the previous loss.
    lbfgs_stalled: float = 1 - 1e-3
    # [1] Number that replaces a loss that is not finite, so that the line search reduces the step.
    too_large: float = 1e12

    # Constants of the regularizer towards the URDF (`fitting.urdf_regularizer`).

    # [1] Number of random positions at which M and gravity of model and URDF are compared.
    regularizer_points: int = 200
    # [1] Margin on both sides of the logged range of positions, as a fraction of this range: a model is also used
    # slightly outside the range.
    regularizer_margin: float = 0.5
    # [1] Lower bound of the scale of a joint's gravity torque, by which errors of this torque are divided, as a
    # fraction of the largest scale of all joints.
    min_gravity_scale: float = 0.05


TUNING = FittingTuning()
