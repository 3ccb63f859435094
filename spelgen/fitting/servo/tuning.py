"""Constants of fits of position servos."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ServoTuning:
    """Constants of fits of position servos, grouped by the file that uses them."""

    # Constants of the windows that a fit predicts (`servo.windows`).

    # [s] Length of a window. Shorter windows hardly show the effects of gravity and friction; in longer windows,
    # predictions with a wrong delay diverge.
    length: float = 4.0
    # [1] Smallest number of samples of a window.
    min_samples: int = 8
    # [s] Burn-in at the beginning of a window, during which the friction state forms. Errors in the burn-in are
    # ignored.
    burn_in: float = 1.0
    # [1] Largest number of windows, evenly spread over the logs. 200 windows of 4 s with 1 s of burn-in contain ten
    # minutes of motion.
    count: int = 200
    # [1] Number of samples for which the load of the bodies is computed at once; it limits the memory.
    batch: int = 2**13

    # Constants of the Gaussian prior about the initial parameters (`servo.parameters`).

    # [1] Prior standard deviation of the logarithms of a joint's gains, armature and friction; exp(2) is a factor of
    # seven.
    logarithm: float = 2.0
    # [1] Prior standard deviation of the logarithm of the Stribeck velocity. With a wider prior, friction could
    # decrease over the whole range of speeds and would then absorb offsets.
    stribeck_velocity: float = 1.0
    # [rad, m] Prior standard deviation of half the width of a dead zone. It is several times the dead zones of the
    # gears of hobby servos, a few mrad, so that the prior is weak.
    dead_zone: float = 0.02
    # [s] Prior standard deviation of the delay of the commands.
    delay: float = 0.1
    # [1] Prior standard deviation of the log-Cholesky parameters of the bodies, along each unit direction that is
    # fitted; 0.3 is about 30 % of a mass.
    bodies: float = 0.3
    # [1] Largest number of directions of the body parameters that are fitted: the directions with the largest effect on
    # gravity. Other directions remain at the prior mean.
    body_directions: int = 6
    # [1] A direction of the body parameters is fitted only if its effect on gravity is at least this fraction of the
    # largest effect.
    min_effect: float = 1e-3
    # [1] Prior standard deviation of a parameter that is not fitted. The deviation is practically zero, so the
    # parameter is constant.
    fixed: float = 1e-9

    # Constants of the cost of a fit and of its derivatives (`servo.problem`, `servo.rollouts`).

    # [s] Upper bound of the estimated correlation time of the position errors. Most measured correlation times are
    # above 0.2 s, so the bound must be larger.
    correlation_time: float = 0.5
    # [1] Finite-difference step of the parameters. The step must be far above the rounding errors of rollouts, which
    # lose about half the digits of double precision.
    difference_step: float = 1e-4
    # [1] Largest change of any parameter in a solver step; most parameters are logarithms, for which 1 is a factor of
    # e.
    max_step: float = 1.0
    # [1] Number of logged positions at which the gravity torque is differentiated with respect to the body parameters.
    # The directions of body parameters with the largest effect on it are fitted (`body_directions`).
    gravity_samples: int = 2000

    # Constants of the outer iterations and their convergence (`servo.objective`).

    # [1] Largest number of windows in an outer iteration, except for the last, which uses all windows.
    sparse_windows: int = 32
    # [1] Largest number of Levenberg-Marquardt steps of an outer iteration.
    steps: int = 12
    # [1] Largest number of steps of the last outer iteration, on all windows: it starts near the minimum, which was
    # found on few windows.
    last_steps: int = 2
    # [1] An outer iteration, or the fit of a single joint, ends if a step decreases the cost by less than this number.
    min_decrease: float = 0.01
    # [1] An outer iteration also ends if a step decreases the cost by less than this fraction of the cost.
    # `min_decrease` is too small for the high costs of a model whose form is wrong.
    min_relative_decrease: float = 1e-4
    # [1] Levenberg-Marquardt damping of the first step of the second and third outer iteration. With 1e-3, the few
    # steps of these iterations would end with an error of kd of 0.3 %.
    later_damping: float = 1e-5
    # [1] Finite-difference step of the derivatives from which the covariance is computed. With a shorter step, the
    # derivatives of a joint that is about to slip would be too large and its intervals too narrow.
    last_difference_step: float = 1e-3

    # Constants of the selection of joints that have a dead zone (`servo.laws`).

    # [1] Initial half width of a dead zone, divided by (dry friction) / kp. This quotient is the static position error
    # of the fit without a dead zone. Coulomb friction is reduced by the same fraction of itself, so that the static
    # error remains about the same.
    dead_zone_fraction: float = 0.25
    # [1] Largest number of Levenberg-Marquardt steps, rejected steps included, of each fit of a single joint: the fit
    # with a dead zone and the fit without.
    joint_steps: int = 6
    # [1] Smallest significance z of a selected dead zone: the dead zone must lower the cost by more than z^2 / 2.
    significance: float = 4.0
    # [rad, m] Dead zones of a smaller half width are set to zero. The step of a 12-bit encoder is 1.5e-3 rad.
    min_dead_zone: float = 1e-3

    # Constants of the confidence intervals and the identifiability of the fitted parameters (`servo.report`).

    # [1] With at least this number of logs, each log is one block of the jackknife, which estimates the covariance of
    # the parameters: parts of one log would not be independent.
    min_logs: int = 3
    # [1] If there are fewer logs than `min_logs`, the logs are divided into at least this number of blocks in total.
    min_blocks: int = 6
    # [1] Variance inflation factor above which a parameter is not distinguished from others; on SO-101 arms, the factor
    # is below 30 or above 90.
    variance_inflation: float = 50.0
    # [1] Standard deviation of log(kd/kp), log(armature/kp) and log(friction/kp) due to errors of the friction model,
    # measured by `benchmarks/servo_recovery.py`. Its square is added to the variance of the fit.
    model_deviation: float = 0.015
    # [1] Largest ratio between the upper end of an interval and the value; with a wider interval, the value counts as
    # not determined.
    max_factor: float = 1.25

    # Constants of the initial guess of a fit, and of the baseline of linear servos (`servo.least_squares`).

    # [1] Smallest t value of the coefficient of gravity, 1 / kp, for which kp is computed from this coefficient. The
    # threshold is large, since neighbouring windows are correlated.
    kp_significance: float = 8.0
    # [rad, m] Smallest standard deviation of positions within windows of a joint that moves. The servo of a joint at
    # rest is not fitted. Also the smallest command error of a load that such a joint carries.
    min_motion: float = 0.01
    # [1] The initial kp is computed from the coefficient of gravity only if kp / nominal kp differs from the median of
    # the joints by less than this factor. The nominal kp itself is no reference: effort limits of URDFs, from which it
    # is computed, are placeholders in many files.
    kp_range: float = 20.0
    # [1] Bound of the magnitude of the logarithms of a linear servo's frequency [rad/s] and damping ratio: logs of a
    # joint at rest bound neither of them.
    max_logarithm: float = 10.0
    # [1] A limit of the torque is not used if this quantile of the magnitude of the servo's torque exceeds it.
    limit_quantile: float = 0.95
    # [1] Number f = 0.05 in the lower bounds of three initial values, whose logarithms are fitted. With the powers of
    # f, in SI units, each bound is about 5 % of a nominal value. Dry friction: f times nominal friction. kd/kp: f^2 =
    # 0.0025 s, 5 % of 0.05 s (`ModelTuning.servo_lag`). armature/kp: f^3 = 0.000125 s^2, 5 % of 1 / (20 rad/s)^2
    # (`frequency`).
    min_friction: float = 0.05
    # [s] Largest delay of the commands in the fit of linear second-order servos, and in the fit of a pure delay.
    max_delay: float = 0.4
    # [s] Initial delay of the commands in the fit of linear second-order servos.
    initial_delay: float = 0.02
    # [rad/s] Initial natural frequency in the fit of linear second-order servos (`LinearServos`), the baseline; the
    # initial damping ratio is 1.
    frequency: float = 20.0


TUNING = ServoTuning()
