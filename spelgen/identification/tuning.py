"""Constants of least squares on logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IdentificationTuning:
    """Least squares on logs, and the assessment of its parameters."""

    # [1] Iterations of the weights of joints from their torque residual; further ones change no printed digit
    # (UR10e).
    rounds: int = 4
    # [1] Smallest noise as a fraction of a joint's torque range: the residual of few samples may be far below the
    # noise.
    least_noise: float = 0.02
    # [1] Largest lag of the autocorrelation of residuals: 500 samples, 5 s.
    largest_lag: int = 500
    # [1] Fraction of the largest singular value below which the samples determine nothing in a direction.
    negligible: float = 1e-10
    # [B] Regressors of up to this size are kept from pass to pass.
    regressor_bytes: float = 2e8
    # [1] Condition number up to which errors are not amplified noticeably.
    well_posed: float = 30.0
    # [1] Condition number up to which parameters are distinguishable.
    acceptable: float = 300.0
    # [1] Relative standard deviation up to which a parameter is called firm.
    firm: float = 0.05
    # [1] Relative standard deviation up to which a parameter is called fair; up to 1 it is called weak.
    fair: float = 0.2
    # [1] Samples that a pass over the logs computes at a time.
    block: int = 2000
    # [1] A column is dependent if the part that other columns do not span is below this fraction of its length.
    dependent: float = 1e-9
    # [1] Coefficients of a base parameter below this fraction of the largest coefficient are 0.
    rounding: float = 1e-8


@dataclass(frozen=True)
class DriveHintTuning:
    """Detection of delayed torques and of coupled motors."""

    # [1] Number of blocks of time, each of which is held out once.
    blocks: int = 10
    # [1] Stride of the samples that select among candidates.
    coarse: int = 4
    # [1] Largest squared residual with a coupling, relative to the one without and, per block, to the squared torque;
    # the wrist of the TX40 has 0.05 and 0.03.
    coupling_gain: float = 0.5
    # [1] Probability that any candidate is accepted by chance, as for residual terms.
    chance: float = 1 / 400
    # [1] Relative increase of the squared residual up to which a ratio of small integers is preferred.
    simple_ratio: float = 0.02
    # [1] Initial ratios of the search for couplings: each covers half to twice its value.
    ratios: tuple[float, ...] = (1.0, -1.0, 0.4, -0.4, 2.5, -2.5)
    # [1] Shifts of the torque in samples of 10 ms: delays of loggers and field buses; longer ones may be due to
    # friction.
    shifts: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)
    # [1] The form with friction state is ignored if its squared residual exceeds the other form's by this
    # factor (recorded arms: 0.3 to 0.8).
    unlikely_form: float = 2.0
    # [1] Error probability of the interval of a delay; small, so that logs without delay are not shifted.
    delay_chance: float = 0.01
    # [1] Number of samples that are kept: six joints have about 70 parameters.
    samples: int = 1500
    # [1] Smallest number of samples for hints and errors.
    fewest_samples: int = 400
    # [1] Largest number of trajectories; of more, an evenly spaced subset is used.
    trajectories: int = 8


@dataclass(frozen=True)
class LogGeometryTuning:
    """Numbers of the test of a log's geometry, chosen by benchmarks/log_geometry.py. Costs: negative log posteriors."""

    # [s] Correlation time of the residuals of recorded arms: samples within it count as one independent error.
    correlation_time: float = 0.2
    # [1] Largest number of independent errors per joint: errors of a rigid model do not average out in long logs.
    max_errors: float = 150.0
    # [1] Smallest residual variance, relative to the torque's: errors of friction models are 2 % of the torque.
    error_floor: float = 4e-4
    # [1] Initial residual variance, relative to the torque's.
    initial_error: float = 0.1
    # [1] Initial weight of the prior.
    initial_scale: float = 0.1
    # [1] Number of reweighting iterations; more change the costs by less than 0.1.
    iterations: int = 6
    # [1] Prior standard deviations of masses (relative), of centres of mass relative to the extent, and of tensors
    # (relative).
    relative_error: float = 0.5
    # Body without an inertial: standard deviation of its mass relative to the other bodies' or 1 kg [1], and extent
    # [m].
    unknown_mass: float = 20.0
    unknown_extent: float = 0.5
    # [m] Smallest extent of a body.
    min_extent: float = 0.03
    # [1] Smallest radius of gyration relative to the extent, for point masses.
    min_gyration: float = 0.3
    # Largest penalties: recorded arms have friction of positive power (shanghai, joint 6) or negative rotor inertia
    # (airbot), not both.
    implausible_inertia: float = 15.0
    implausible_friction: float = 10.0
    # Smallest cost decrease of an accepted hypothesis: the best wrong one on recorded arms has 16.
    needed: float = 20.0
    # Cost difference up to which two hypotheses count as equally good, and are both reported.
    ambiguous: float = 8.0
    # [1] Largest number of changes of a hypothesis; an order of joints counts as one.
    changes: int = 3
    # [1] Largest number of hypotheses in a message.
    named: int = 3
    # [1] Random initial orders of joints in the search, in addition to three plausible ones.
    random_orders: int = 6
    # Penalty of a change that is rarer than a wrong sense or order.
    rare: float = 1.0
    # [1] Samples for the comparison of all hypotheses.
    samples: int = 200
    # [1] Number of regressors in memory, of about 1 MB each.
    kept: int = 30
    # [1] Samples for the comparison of the best hypotheses.
    confirming_samples: int = 800
    # Gauss-Newton steps of an offset, or of the direction of gravity.
    refinements: int = 4
    # [rad] Zero offsets and tilts of the base below this bound are calibration errors.
    min_angle: float = 0.09
    # [m] Zero offsets of prismatic joints below this bound are calibration errors.
    min_shift: float = 0.01
    # Cost increase up to which a multiple of 90 degrees is preferred to the best angle.
    right_angle: float = 3.0
    # [rad] Zero offsets and tilts of the base below this bound are warnings, not errors.
    serious_angle: float = 0.17
    # [1] Ratio of a first moment to the URDF's above which it is reported: errors of CAD models are smaller.
    wrong_moment: float = 2.5
    # [1] Number of standard deviations by which this ratio must differ from 1.
    certain: float = 4.0
    # [1] Smallest visible gravity torque of a body, relative to the largest standard deviation of a joint's torque.
    visible: float = 0.5
    # [1] Fraction of the URDF's gravity torque at all joints, below which a controller compensates gravity.
    compensated: float = 0.5


TUNING, HINTS, GEOMETRY = IdentificationTuning(), DriveHintTuning(), LogGeometryTuning()
