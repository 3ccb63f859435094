"""Constants of least squares on logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class IdentificationTuning:
    """Numbers that decide how least squares judges what it found."""

    rounds: int = 4  # of weighing joints by what is left of their torque; later ones change no digit (UR10e)
    least_noise: float = 0.02  # of a joint's torque range: few samples may be fitted better than deserved
    largest_lag: int = 500  # [samples] over which residuals are followed in time: 5 s
    negligible: float = 1e-10  # of the largest singular value: a direction in which the samples say nothing
    regressor_bytes: float = 2e8  # [B] of regressors, up to which they are kept from pass to pass
    well_posed: float = 30.0  # condition number up to which errors are hardly amplified
    acceptable: float = 300.0  # condition number up to which parameters can be told apart
    firm: float = 0.05  # of a value, the deviation up to which it is firm
    fair: float = 0.2  # likewise fair; above, up to the value itself, weak
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
    # likewise of a swapped or negated torque; recorded arms lose a factor of 4 by either
    wrong_gain: float = 0.25
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


TUNING, HINTS = IdentificationTuning(), DriveHintTuning()
