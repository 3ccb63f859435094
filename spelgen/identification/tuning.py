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
    # [1] Fraction of the largest singular value below which the samples determine nothing in a direction.
    negligible: float = 1e-10
    # [B] Regressors of up to this size are kept from pass to pass.
    regressor_bytes: float = 2e8
    # [1] Samples that a pass over the logs computes at a time.
    block: int = 2000


@dataclass(frozen=True)
class DriveHintTuning:
    """Detection of delayed torques and of coupled motors."""

    # [1] Blocks of time, each predicted from the others.
    blocks: int = 10
    # [1] Largest residual with a coupling, relative to the squared error and, per block, to the squared torque; the
    # TX40's wrist has 0.05 and 0.03.
    coupling_gain: float = 0.5
    # [1] Shifts of the torque in samples of 10 ms: delays of loggers and field buses; longer ones may be due to
    # friction.
    shifts: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)
    # [1] Samples that are kept: six joints have some 70 parameters.
    samples: int = 1500
    # [1] Smallest number of samples for hints and errors.
    fewest_samples: int = 400
    # [1] Largest number of trajectories; of more, only an even part is used.
    trajectories: int = 8


@dataclass(frozen=True)
class LogGeometryTuning:
    """Numbers of the test of a log's geometry, chosen by benchmarks/log_geometry.py. Costs: negative log posteriors."""

    # [1] of the torque's variance, is always left: friction models err by 2 % of the torque
    error_floor: float = 4e-4
    # cost by which another hypothesis must be better: the recorded arms' best wrong one gains 16
    needed: float = 20.0
    # Cost by which two hypotheses must differ for only one to be named.
    ambiguous: float = 8.0
    # Cost of a change that is rarer than a wrong sense or order.
    rare: float = 1.0
    # For the best ones.
    confirming_samples: int = 800
    # [rad] smaller zero offsets and tilts of the base are errors of calibration.
    min_angle: float = 0.09
    # [m] likewise of prismatic joints.
    min_shift: float = 0.01
    # Cost up to which a multiple of 90 degrees is preferred to the best angle.
    right_angle: float = 3.0
    # [rad] zero offsets and tilts of the base below are warnings.
    serious_angle: float = 0.17


TUNING, HINTS, GEOMETRY = IdentificationTuning(), DriveHintTuning(), LogGeometryTuning()
