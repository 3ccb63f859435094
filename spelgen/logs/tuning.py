"""Constants of reading, checking and preparing logs, and the limits of their sample rates."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LogTuning:
    """Constants of logs that several functions use."""

    # [B] Numbers that a fit keeps of all logs together: 25 minutes of seven joints at 1 kHz, or 76,000 samples of a
    # torque fit, about the number that its last iterations use. Windows of five samples take five times the memory.
    kept_bytes: int = 2**28
    # [1] Largest number of samples of a segment of logs that exceed `kept_bytes`: 16 s at 1 kHz, long compared with
    # filter transients.
    segment_samples: int = 2**14
    # [B] Largest unpacked size of an NPZ archive: zeros are packed a thousandfold.
    npz_bytes: int = 2**30
    # [rad, rad/s, Nm; m, m/s, N] Largest magnitude of a signal; larger ones have a wrong unit.
    largest_value: float = 1e9
    # [s] Largest time, so that its fourth power does not overflow.
    latest: float = 1e24
    # [s] Shortest time between samples, so that its fourth power does not underflow.
    shortest_step: float = 1e-15
    # [1] A step that exceeds this multiple of the typical step is a jump, and a 0 between samples whose magnitudes
    # exceed it is a missing value: continuous signals approach 0 gradually.
    jump: float = 20.0
    # [1] Samples on each side of an outlier that are its neighbours.
    jump_window: int = 8
    # [1] A step longer than this multiple of the median step is a gap; jitter of USB loggers stays below 3.
    gap: float = 4.0
    # [Hz] Cutoff of the low-pass filter by default: rigid-body motion lies below, ripple and quantisation above
    # (UR10e).
    automatic_cutoff: float = 8.0
    # [1] Smallest number of samples per period of the cutoff; Nyquist's bound is two.
    samples_per_period: int = 3
    # [Hz] Logs of a lower rate are interpolated by cubics, and their windows are not filtered.
    dense_rate: float = 50.0
    # [1] Largest number of columns in a message.
    listed: int = 5


@dataclass(frozen=True)
class SignalCheckTuning:
    """Thresholds of the checks of logs that several checks use."""

    # [1] Correlation from which on two signals are proportional; 1 minus it is the tolerance of a factor of 1.
    agreement: float = 0.9
    # [1] Samples over which q and the integral of qd are compared: between neighbours the quantisation of q may be
    # larger than its change.
    increments: int = 10
    # [s] Smallest and largest median time between samples: no arm is sampled above 10 kHz or below 2 Hz.
    fastest_step: float = 1e-4
    slowest_step: float = 0.5


@dataclass(frozen=True)
class SampleTuning:
    """Samples of the dynamics: filtered, and on a common grid of time."""

    # [rad/s, m/s] A joint is at rest below this speed; samples of an arm at rest determine no dynamics.
    moving: float = 0.02


TUNING, SIGNALS, SAMPLES = LogTuning(), SignalCheckTuning(), SampleTuning()

SLOWEST = TUNING.samples_per_period * TUNING.automatic_cutoff  # [Hz] lowest rate for accelerations
# No bound of a rate is exact: nominal 50 Hz are 49.95 Hz with one logger and 50.1 Hz with another.
FAST = 1.002


def shows_accelerations(rate: float) -> bool:
    """Return True if logs of this rate [Hz] determine accelerations: the filter's cutoff is below Nyquist's bound."""
    return rate * FAST >= SLOWEST


def is_dense(rate: float) -> bool:
    """Return True if linear interpolation between samples suffices at this rate [Hz]."""
    return rate * FAST >= TUNING.dense_rate
