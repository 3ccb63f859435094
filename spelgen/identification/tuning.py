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
    # [1] Samples of one block of a pass.
    block: int = 2000
    # [1] A column is dependent if the part that other columns do not span is below this fraction of its length.
    dependent: float = 1e-9
    # [1] Coefficients of a base parameter below this fraction of the largest coefficient are 0.
    rounding: float = 1e-8


@dataclass(frozen=True)
class DriveHintTuning:
    """Detection of delayed torques, of coupled motors, and of torques of wrong sense or order."""

    # [1] Blocks of time, each predicted from the others.
    blocks: int = 10
    # [1] Stride of the samples that select among candidates.
    coarse: int = 4
    # [1] Largest residual with a coupling, relative to the squared error and, per block, to the squared torque; the
    # TX40's wrist has 0.05 and 0.03.
    coupling_gain: float = 0.5
    # [1] The same for a swapped or negated torque; recorded arms have a quarter or less.
    wrong_gain: float = 0.25
    # [1] Probability that any candidate is accepted by chance, as for terms of a fit.
    chance: float = 1 / 400
    # [1] Relative increase of the squared error that is accepted for a ratio of small integers.
    simple_ratio: float = 0.02
    # [1] Initial ratios of the search for couplings: each covers half to twice its value.
    ratios: tuple[float, ...] = (1.0, -1.0, 0.4, -0.4, 2.5, -2.5)
    # [1] Shifts of the torque in samples of 10 ms: delays of loggers and field buses; longer ones may be due to
    # friction.
    shifts: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)
    # [1] The form with friction state is ignored if its squared residual exceeds that of the other form by this
    # factor (recorded arms: 0.3 to 0.8).
    unlikely_form: float = 2.0
    # [1] Probability outside a delay's interval: a log without delay must not get one.
    delay_chance: float = 0.01
    # [1] Samples that are kept: six joints have some 70 parameters.
    samples: int = 1500
    # [1] Smallest number of samples for hints and errors.
    fewest_samples: int = 400
    # [1] Largest number of trajectories; of more, whole ones are left out.
    trajectories: int = 8


TUNING, HINTS = IdentificationTuning(), DriveHintTuning()
