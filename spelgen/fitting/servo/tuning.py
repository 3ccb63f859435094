"""Constants of fits of position servos."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ServoTuning:
    """Constants of fits of position servos, by the file that reads them."""

    # Windows that a fit predicts (`servo.windows`).

    # [s] Length of a window: gravity and friction need as long to become visible, and longer windows diverge with the
    # delay.
    length: float = 4.0
    # [1] Smallest number of samples of a window.
    min_samples: int = 8
    # [s] Burn-in at the beginning of a window, during which the friction state forms; its errors do not count.
    burn_in: float = 1.0
    # [1] Largest number of windows, evenly spread: ten minutes of motion.
    count: int = 200
    # [1] Samples whose load is computed at once, which bounds the memory.
    batch: int = 2**13

    # Standard deviations of the Gaussian prior, about the initial parameters (`servo.parameters`).

    # [1] Logarithms of a joint's gains, armature and friction: a factor of seven.
    logarithm: float = 2.0
    # [1] Logarithm of the Stribeck velocity: with a wider prior friction that decreases at any speed absorbs offsets.
    stribeck_velocity: float = 1.0
    # [rad, m] Half of a dead zone: gears of hobby servos have a few mrad.
    dead_zone: float = 0.02
    # [s] Delay of the commands.
    delay: float = 0.1
    # [1] Log-Cholesky parameters of the bodies: 30 % in mass.
    bodies: float = 0.3
    # [1] Directions of the body parameters that are fitted, those with the largest effect on gravity; further ones
    # stay within their prior.
    body_directions: int = 6
    # [1] Smallest effect of such a direction on gravity, relative to the largest effect.
    min_effect: float = 1e-3
    # [1] Prior standard deviation of a parameter that is not fitted.
    fixed: float = 1e-9

    # Cost and its derivatives (`servo.problem`, `servo.rollouts`).

    # [s] Largest correlation time of the errors; most measured ones are above 0.2 s.
    correlation_time: float = 0.5
    # [1] Finite-difference step of the parameters: rollouts in double precision lose half of their digits.
    difference_step: float = 1e-4
    # [1] Largest step of any parameter; most are logarithms.
    max_step: float = 1.0
    # [1] Samples for the directions of the body parameters.
    gravity_samples: int = 2000

    # Convergence (`servo.objective`).

    # [1] Largest number of windows in all outer iterations but the last.
    sparse_windows: int = 32
    # [1] Largest number of steps of an outer iteration.
    steps: int = 12
    # [1] Steps of the last outer iteration, on all windows: it starts near the minimum of few windows.
    last_steps: int = 2
    # Decrease of the cost below which an outer iteration, or the fit of a joint with and without dead zone, ends.
    min_decrease: float = 0.01
    # [1] Decrease relative to the cost below which an outer iteration ends: costs are high if the form of the model is
    # wrong.
    min_relative_decrease: float = 1e-4
    # [1] Damping of the first step of all outer iterations but the first; with 1e-3 kd has an error of 0.3 %.
    later_damping: float = 1e-5
    # [1] Finite-difference step of the last derivatives: with shorter steps a joint that is about to slip seems
    # determined.
    last_difference_step: float = 1e-3

    # Selection of the joints that have a dead zone (`servo.laws`).

    # [1] Initial dead zone, as a fraction of the static error.
    dead_zone_fraction: float = 0.25
    # [1] Largest number of steps of the fit of a single joint.
    joint_steps: int = 6
    # [1] Standard deviations by which a dead zone must be more probable; other friction effects need 3.
    significance: float = 4.0
    # [rad, m] Smallest dead zone: the step of a 12-bit encoder is 1.5e-3 rad.
    min_dead_zone: float = 1e-3

    # Intervals and identifiability of the fitted parameters (`servo.report`).

    # [1] Smallest number of logs of which each is one block of the covariance: halves of one motion are not
    # independent.
    min_logs: int = 3
    # [1] Smallest number of blocks into which fewer logs are divided.
    min_blocks: int = 6
    # [1] Variance inflation above which two effects are indistinguishable; on SO-101s it is below 30 or above 90.
    variance_inflation: float = 50.0
    # [1] Standard deviation of ratios due to the form of the friction model: `benchmarks/servo_recovery.py`.
    model_deviation: float = 0.015
    # [1] A value whose interval reaches beyond this factor is not determined.
    max_factor: float = 1.25

    # Initial guess and baseline (`servo.least_squares`).

    # [1] Number of standard deviations above which kp is computed from the coefficient of gravity; large, since
    # neighbouring windows are correlated.
    kp_significance: float = 8.0
    # [1] Largest factor between the initial and the nominal kp (of the settings, or 2 efforts per radian).
    kp_range: float = 20.0
    # Smallest dry friction as a fraction of nominal friction [1]. Its square and its cube are the smallest kd/kp [s]
    # and armature/kp [s^2]: positive, since logarithms are fitted.
    min_friction: float = 0.05
    # [s] Upper bound of the delays of linear servos, and their initial delay.
    max_delay: float = 0.4
    initial_delay: float = 0.02
    # [rad/s] Initial natural frequency; the initial damping ratio is 1.
    frequency: float = 20.0


TUNING = ServoTuning()
