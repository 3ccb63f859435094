"""Constants of linear least squares on logs: identification, torque delays, couplings, faults of a log's columns."""

from dataclasses import dataclass


@dataclass(frozen=True)
class IdentificationTuning:
    """Constants of the linear identification, and of the standard deviations of its parameters."""

    # [1] Number of iterations that recompute the weights of joints from their torque residuals; on a UR10e, further
    # iterations change no printed digit.
    rounds: int = 4
    # [1] Lower bound of a joint's noise, as a fraction of the standard deviation of the torque: the residual of few
    # samples may be far below the noise.
    least_noise: float = 0.02
    # [1] A direction in the space of parameters is undetermined if its singular value is below this fraction of the
    # largest singular value.
    negligible: float = 1e-10
    # [B] Regressors of up to this size are kept in memory; larger ones are recomputed in each pass over the samples.
    regressor_bytes: float = 2e8
    # [1] Number of samples whose regressor is computed at a time.
    block: int = 2000


@dataclass(frozen=True)
class DriveHintTuning:
    """Constants of the detection of delayed torques and of coupled motors."""

    # [1] Number of blocks of time in the cross-validation; each block is held out once.
    blocks: int = 10
    # [1] A coupling is accepted if the squared residual with it is below this fraction of the squared residual without
    # it and, in each block, below this fraction of the squared torque. For the coupled wrist joints of a Staubli TX40
    # these fractions are 0.05 and 0.03.
    coupling_gain: float = 0.5
    # [s] Longest delay of the torques of all joints. It covers the delays of loggers and field buses; a longer apparent
    # delay may be due to friction.
    longest_delay: float = 0.02
    # [samples at 100 Hz] Largest delay of the signals of one joint relative to the other joints, 160 ms.
    longest_offset: int = 16
    # [1] Largest number of samples of the estimation of delays and couplings, ample for about 70 parameters of six
    # joints.
    samples: int = 1500
    # [1] Smallest number of samples for the detection of couplings; tests for faults of a log need a quarter of it.
    fewest_samples: int = 400
    # [1] Largest number of trajectories of the estimation of delays and couplings; more are subsampled evenly.
    trajectories: int = 8


@dataclass(frozen=True)
class LogGeometryTuning:
    """Constants of the tests whether a log's columns and the URDF agree, chosen by benchmarks/log_geometry.py.

    Faults are exchanged joints, wrong senses, zeros, units or times of columns, and a wrong direction of gravity. Costs
    are negative log posteriors.
    """

    # [1] Constant added to a joint's relative residual variance: (2 %)^2, since errors of friction models are 2 % of
    # the torque.
    error_floor: float = 4e-4
    # [1] Smallest cost decrease of an accepted hypothesis. On recorded arms the largest decrease of a wrong hypothesis
    # is 17.
    needed: float = 20.0
    # [1] A friction model with hysteresis is fitted under a hypothesis only if the hypothesis lowers the cost without
    # hysteresis by more than this value.
    slight: float = 3.0
    # [1] Number of the best hypotheses under which a friction model with hysteresis is fitted, too.
    weighed: int = 10
    # [1] Number of the best hypotheses to which a further correction is added if the best one does not explain the
    # torques of all joints (see `explained`).
    beam: int = 3
    # [1] Cost difference up to which two hypotheses count as equally good, and are both reported.
    ambiguous: float = 8.0
    # [1] Torques have another unit if their ratio to the URDF's gravity torques is at least this factor, or at most its
    # inverse: inertials of a URDF are wrong by less.
    other_unit: float = 5.0
    # [kg/m^3] Mass of a link whose mass is guessed, divided by its length and the square of the arm's reach. The
    # gravity torques of 120 URDFs of arms with four or more revolute joints are 0.14 to 3.6 times as large as with it.
    link_density: float = 14.0
    # [1] The same limit as `other_unit` for gravity torques of guessed masses.
    guessed_unit: float = 30.0
    # [1] A hypothesis lowers the mean relative residual variance of the joints noticeably if the variance with the
    # hypothesis is below this fraction of the variance without it.
    lower: float = 0.9
    # [1] A hypothesis explains the torques of a joint if their residual variance is at most this fraction of their
    # variance.
    explained: float = 0.05
    # [1] The friction model with hysteresis explains the torques if the relative residual variance of every moving
    # joint is below this value. With wrong senses, orders, units, zeros or gravity, the largest value of a joint is
    # usually above 0.019 (benchmarks/log_geometry.py, 16 arms); joints of symmetric wrists are an exception.
    exact: float = 0.01
    # [1] A hypothesis lowers the squared residual of at least one moving joint to this fraction, or has more plausible
    # parameters: errors of the friction model lower many residuals a little.
    clear: float = 0.7
    # [1] Mean relative residual variance of the joints above which the columns of a log are probably in another order.
    unexplained: float = 0.15
    # [1] A recording has a fault of its own if its squared torque residual is larger than this multiple of the squared
    # residual of the other recordings, to which the model is fitted.
    deviation: float = 5.0
    # [1] A hypothesis does not explain the torques if the relative residual variance (residual variance / variance of
    # the torque) is above this value at a joint, and also in a weighted mean of the joints. The weight of a joint is
    # the change of its relative residual variance by the hypothesis: joints that the hypothesis does not affect do not
    # count, except for combinations of faults. With the right correction, logs of recorded arms have at most 0.07 in
    # the mean of all joints, although up to 0.27 at a joint whose torque is mostly friction.
    no_advice: float = 0.2
    # [1] If the rigid-body and friction model is fitted to the log without corrections, and the residual variance /
    # variance of the torque is above this value in the mean of the joints or at a loaded joint, the logged columns are
    # probably no joint torques.
    no_torque: float = 0.6
    # [1] Standard deviation of the mass of a tool or load that the URDF does not contain, divided by the median mass of
    # the arm's links.
    load: float = 0.5
    # [m] Standard deviation of the distance between the centre of mass of a tool or load that the URDF does not contain
    # and the origin of the last body.
    load_distance: float = 0.15
    # [1] Largest number of samples for the comparison of all hypotheses.
    coarse_samples: int = 200
    # [1] Largest number of samples for the final comparison of the best hypotheses.
    confirming_samples: int = 800
    # [rad] Zero offsets below this bound are calibration errors and are not reported.
    min_angle: float = 0.09
    # [rad] Tilts of the base below this bound are errors of the mounting and are not reported.
    min_tilt: float = 0.06
    # [m, rad] Zero offsets of prismatic joints below this bound are calibration errors and are not reported. It is also
    # the accuracy, in rad, of large zero offsets of revolute joints.
    min_shift: float = 0.01
    # [s] Delays of single joints below this bound are not reported: friction causes an apparent delay of up to 30 ms.
    min_delay: float = 0.03
    # [s] The search for a delay starts from zero, this delay, its quadruple or their negatives, whichever fits best.
    delay_start: float = 0.06
    # [s] Longest delay that is searched; delays of buffers and of other topics are shorter.
    longest_delay: float = 0.5
    # [s] Initial guesses of the delay at the end of a log, for the search for the rate of a clock.
    clock_starts: tuple[float, ...] = (-0.4, -0.15, 0.15, 0.4)
    # [1] Largest relative error of a clock's rate. A larger error is rejected, since it would explain other errors of
    # the model, such as friction of slow motions.
    clock_error: float = 0.05
    # [1] A delay is accepted if the squared residual of a joint with the delay is below this fraction of its value
    # without delay; wrong delays have fractions from 0.78 on, on recordings of seven arms.
    delay_gain: float = 0.65
    # [1] A joint's torques were logged as magnitudes if the squared residual with restored signs is below this fraction
    # of the squared residual with the logged torques.
    unsigned_gain: float = 0.4
    # [1] Increase of the cost up to which a multiple of 90 degrees is preferred to the angle of minimum cost.
    right_angle: float = 3.0
    # [rad] Zero offsets and tilts of the base up to this bound are reported as warnings, larger ones as errors.
    serious_angle: float = 0.17
    # [m] Zero offsets of prismatic joints up to this bound are reported as warnings, larger ones as errors. A link of
    # 0.3 m, tilted by `serious_angle`, has its end displaced by this distance.
    serious_shift: float = 0.05


TUNING, HINTS, GEOMETRY = IdentificationTuning(), DriveHintTuning(), LogGeometryTuning()
