"""Hold the tuned numbers of least squares on logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IdentificationTuning:
    """Numbers that decide which samples least squares gets, and how it judges what it found."""

    sample_rate: float = 100.0  # [Hz] of the common grid: twelve times the low-pass, as is usual
    moving: float = 0.02  # [rad/s, m/s] joints that are slower rest, and say nothing of dynamics
    shortest_piece: float = 1.0  # [s] shorter pieces are all filter transient
    # [periods of the filter's cutoff] at both ends of a piece, where the filter is off by 20 times what noise is
    unsettled: float = 0.75
    rounds: int = 4  # of weighing joints by what is left of their torque; later ones change no digit (UR10e)
    least_noise: float = 0.02  # of a joint's torque range: few samples may be fitted better than deserved
    largest_lag: int = 500  # [samples] over which residuals are followed in time: 5 s
    negligible: float = 1e-10  # of the largest singular value: a direction in which the samples say nothing
    regressor_bytes: float = 2e8  # [B] of regressors, up to which they are kept from pass to pass
    well_posed: float = 30.0  # condition number up to which errors are hardly amplified
    acceptable: float = 300.0  # condition number up to which parameters can be told apart
    firm: float = 0.05  # of a value, the deviation up to which it is firm
    fair: float = 0.2  # likewise fair; above, up to the value itself, weak
    # [rad/s, m/s] at which the extra dry friction of slow motion has fallen to 1/e
    stribeck_velocity: float = 0.1
    block: int = 2000  # samples in memory at a time
    dependent: float = 1e-9  # of its own length: what is left of a column that others span
    rounding: float = 1e-8  # of the largest coefficient of a base parameter: smaller ones are none


@dataclass(frozen=True)
class DriveHintTuning:
    """Numbers from which on logs are said to show late torques or coupled motors."""

    blocks: int = 10  # of time, each judged by what the others say
    coarse: int = 4  # one of so many samples chooses among candidates
    # of the squared error, and in each block of the torque's squares, what a coupling leaves at most; the TX40's wrist
    # leaves 0.05 and 0.03
    coupling_gain: float = 0.5
    chance: float = 1 / 400  # that any candidate is taken by luck, as of what enters a fit
    simple_ratio: float = 0.02  # of the squared error, what a ratio of small numbers may cost
    # that begin the search for couplings: each covers half of it to twice
    ratios: tuple[float, ...] = (1.0, -1.0, 0.4, -0.4, 2.5, -2.5)
    # [samples of 10 ms] by which torques are moved to find a delay: of loggers and field buses; more may be friction's
    shifts: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)
    # [1] of the squares without friction's memory: memory that leaves more does not count (recorded arms: 0.3 to 0.8)
    unlikely_form: float = 2.0
    delay_chance: float = 0.01  # [1] outside a delay's interval: a log without delay must not get one
    samples: int = 1500  # that are kept: six joints have some 70 parameters
    fewest_samples: int = 400  # that hints and errors need
    trajectories: int = 8  # of more, whole ones are left out


@dataclass(frozen=True)
class GeometryTuning:
    """Numbers of the test of a log's geometry, chosen by benchmarks/log_geometry.py. Costs: negative log posteriors."""

    # [s] residuals of recorded arms stay correlated for about 0.2 s: the likelihood counts one error in that time
    correlation_time: float = 0.2
    # at most so many errors per joint: what a rigid model lacks does not average out in long logs
    max_errors: float = 150.0
    # [1] of the torque's variance, is always left: friction models err by 2 % of the torque
    error_floor: float = 4e-4
    initial_error: float = 0.1  # [1] of the torque's variance, before the first iteration
    initial_scale: float = 0.1  # of the prior's weight, before the first iteration
    iterations: int = 6  # of reweighting; the costs change by less than 0.1 after
    # [1] standard deviations of masses, of centres of mass relative to the extent, and of tensors
    relative_error: float = 0.5
    # [1] of the other bodies' mass or 1 kg, and [m]: standard deviation and extent of a body without an inertial
    unknown_mass: float = 20.0
    unknown_extent: float = 0.5
    min_extent: float = 0.03  # [m] of a body
    min_gyration: float = 0.3  # [1] radius of gyration relative to the extent: point masses have none
    # costs at most: recorded arms have friction that drives (shanghai's joint 6) or negative inertia (airbot), not both
    implausible_inertia: float = 15.0
    implausible_friction: float = 10.0
    # cost by which another hypothesis must be better: the recorded arms' best wrong one gains 16
    needed: float = 20.0
    ambiguous: float = 8.0  # cost by which two hypotheses must differ for one to be named alone
    changes: int = 3  # that a reading has at most, an order of joints as one
    named: int = 3  # readings that a message names at most
    rare: float = (
        1.0  # cost of a change that is rarer than a wrong sense or order, of two that explain as much
    )
    samples: int = 200  # for comparing all hypotheses
    kept: int = 30  # regressors in memory, of about 1 MB
    confirming_samples: int = 800  # for the best ones
    refinements: int = 4  # Gauss-Newton steps of an offset, or of the direction of gravity
    min_angle: float = 0.09  # [rad] smaller zero offsets and tilts of the base are errors of calibration
    min_shift: float = 0.01  # [m] likewise of prismatic joints
    right_angle: float = 3.0  # cost up to which a multiple of 90 degrees is preferred to the best angle
    serious_angle: float = 0.17  # [rad] zero offsets and tilts of the base below are warnings
    compensated: float = 0.5  # [1] of the URDF's gravity: with less in all joints it is compensated


TUNING = IdentificationTuning()
GEOMETRY = GeometryTuning()
HINTS = DriveHintTuning()
