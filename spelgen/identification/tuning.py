"""Constants of least squares on logs."""

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
    # [1] Fraction of the largest singular value below which the samples determine nothing in a direction.
    negligible: float = 1e-10
    # [B] Regressors of up to this size are kept from pass to pass.
    regressor_bytes: float = 2e8
    # [1] Samples that a pass over the logs computes at a time.
    block: int = 2000


@dataclass(frozen=True)
class DriveHintTuning:
    """Detection of delayed torques and of coupled motors."""

    # [1] Number of blocks of time, each of which is held out once.
    blocks: int = 10
    # [1] Largest squared residual with a coupling, relative to the one without and, per block, to the squared torque;
    # the wrist of the TX40 has 0.05 and 0.03.
    coupling_gain: float = 0.5
    # [1] Shifts of the torque in samples of 10 ms: delays of loggers and field buses; longer ones may be due to
    # friction.
    shifts: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)
    # [1] Number of samples that are kept: six joints have about 70 parameters.
    samples: int = 1500
    # [1] Smallest number of samples for hints and errors.
    fewest_samples: int = 400
    # [1] Largest number of trajectories; of more, an evenly spaced subset is used.
    trajectories: int = 8


@dataclass(frozen=True)
class LogGeometryTuning:
    """Numbers of the test of a log's geometry, chosen by benchmarks/log_geometry.py. Costs: negative log posteriors."""

    # [1] Smallest residual variance, relative to the torque's: errors of friction models are 2 % of the torque.
    error_floor: float = 4e-4
    # Smallest cost decrease of an accepted hypothesis: the best wrong one on recorded arms has 16.
    needed: float = 20.0
    # Cost difference up to which two hypotheses count as equally good, and are both reported.
    ambiguous: float = 8.0
    # Penalty of a change that is rarer than a wrong sense or order.
    rare: float = 1.0
    # [1] Samples for the comparison of the best hypotheses.
    confirming_samples: int = 800
    # [rad] Zero offsets and tilts of the base below this bound are calibration errors.
    min_angle: float = 0.09
    # [m] Zero offsets of prismatic joints below this bound are calibration errors.
    min_shift: float = 0.01
    # Cost increase up to which a multiple of 90 degrees is preferred to the best angle.
    right_angle: float = 3.0
    # [rad] Zero offsets and tilts of the base below this bound are warnings, not errors.
    serious_angle: float = 0.17


TUNING, HINTS, GEOMETRY = IdentificationTuning(), DriveHintTuning(), LogGeometryTuning()
