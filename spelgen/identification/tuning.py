"""Constants of least squares on logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IdentificationTuning:
    """Least squares on logs, and the assessment of its parameters."""

    # [1] Iterations of the weights of joints from their torque residual; further ones change no printed digit
    # (UR10e).
    rounds: int = 4
    # [1] Smallest noise as a fraction of a joint's torque range: few samples may be fitted better than they are
    # determined.
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

    # [1] Blocks of time, each predicted from the others.
    blocks: int = 10
    # [1] Stride of the samples that select among candidates.
    coarse: int = 4
    # [1] Largest residual with a coupling, relative to the squared error and, per block, to the squared torque; the
    # TX40's wrist has 0.05 and 0.03.
    coupling_gain: float = 0.5
    # [1] Probability that any candidate is accepted by chance, as for terms of a fit.
    chance: float = 1 / 400
    # [1] Relative increase of the squared error that is accepted for a ratio of small integers.
    simple_ratio: float = 0.02
    # [1] Initial ratios of the search for couplings: each covers half to twice its value.
    ratios: tuple[float, ...] = (1.0, -1.0, 0.4, -0.4, 2.5, -2.5)
    # [1] Shifts of the torque in samples of 10 ms: delays of loggers and field buses; longer ones may be due to
    # friction.
    shifts: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)
    # [1] The form with friction state is ignored if its squared residual exceeds the other form's by this
    # factor (recorded arms: 0.3 to 0.8).
    unlikely_form: float = 2.0
    # [1] Probability outside a delay's interval: a log without delay must not get one.
    delay_chance: float = 0.01
    # [1] Samples that are kept: six joints have some 70 parameters.
    samples: int = 1500
    # [1] Smallest number of samples for hints and errors.
    fewest_samples: int = 400
    # [1] Largest number of trajectories; of more, only an even part is used.
    trajectories: int = 8


@dataclass(frozen=True)
class LogGeometryTuning:
    """Numbers of the test of a log's geometry, chosen by benchmarks/log_geometry.py. Costs: negative log posteriors."""

    # [s] residuals of recorded arms stay correlated for about 0.2 s: the likelihood counts one error in that time
    correlation_time: float = 0.2
    # at most this number of errors per joint: the errors of a rigid model do not average out in long logs
    max_errors: float = 150.0
    # [1] of the torque's variance, is always left: friction models err by 2 % of the torque
    error_floor: float = 4e-4
    # [1] of the torque's variance, before the first iteration.
    initial_error: float = 0.1
    # Of the prior's weight, before the first iteration.
    initial_scale: float = 0.1
    # Of reweighting; the costs change by less than 0.1 after.
    iterations: int = 6
    # [1] standard deviations of masses, of centres of mass relative to the extent, and of tensors
    relative_error: float = 0.5
    # [1] of the other bodies' mass or 1 kg, and [m]: standard deviation and extent of a body without an inertial
    unknown_mass: float = 20.0
    unknown_extent: float = 0.5
    # [m] of a body.
    min_extent: float = 0.03
    # [1] radius of gyration relative to the extent: point masses have none.
    min_gyration: float = 0.3
    # costs at most: recorded arms have friction that drives (shanghai's joint 6) or negative inertia (airbot), not both
    implausible_inertia: float = 15.0
    implausible_friction: float = 10.0
    # cost by which another hypothesis must be better: the recorded arms' best wrong one gains 16
    needed: float = 20.0
    # Cost by which two hypotheses must differ for only one to be named.
    ambiguous: float = 8.0
    # That a reading has at most, an order of joints as one.
    changes: int = 3
    # Readings that a message names at most.
    named: int = 3
    # Random orders at which the search for the order of joints starts, in addition to three plausible ones.
    random_orders: int = 6
    # Cost of a change that is rarer than a wrong sense or order.
    rare: float = 1.0
    # For comparing all hypotheses.
    samples: int = 200
    # Regressors in memory, of about 1 MB.
    kept: int = 30
    # For the best ones.
    confirming_samples: int = 800
    # Gauss-Newton steps of an offset, or of the direction of gravity.
    refinements: int = 4
    # [rad] smaller zero offsets and tilts of the base are errors of calibration.
    min_angle: float = 0.09
    # [m] likewise of prismatic joints.
    min_shift: float = 0.01
    # Cost up to which a multiple of 90 degrees is preferred to the best angle.
    right_angle: float = 3.0
    # [rad] zero offsets and tilts of the base below are warnings.
    serious_angle: float = 0.17
    # [1] Ratio of a first moment to the URDF's that errors of a CAD model do not explain.
    wrong_moment: float = 2.5
    # [1] Standard deviations by which such a ratio must differ from 1.
    certain: float = 4.0
    # [1] of the largest joint torque's standard deviation: smaller gravity torques of a body are not visible.
    visible: float = 0.5
    # [1] of the URDF's gravity: with less in all joints it is compensated.
    compensated: float = 0.5


TUNING, HINTS, GEOMETRY = IdentificationTuning(), DriveHintTuning(), LogGeometryTuning()
