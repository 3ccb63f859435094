"""Constants for reading, checking and preprocessing logs, and limits of the logs' sample rates."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LogTuning:
    """Constants of the reading and preprocessing of logs."""

    # [B] Memory limit of the log samples that a fit keeps. It suffices for 25 minutes of seven joints at 1 kHz, from
    # which a torque fit makes 76,000 samples, about the number that its last iterations use. If a fit cuts the samples
    # into windows of five samples that overlap, one for each sample, the windows need five times this memory.
    kept_bytes: int = 2**28
    # [1] Largest number of samples of a segment. Logs that exceed `kept_bytes` are divided into segments, of which only
    # some are kept. 16 s at 1 kHz is long compared with filter transients.
    segment_samples: int = 2**14
    # [B] Largest unpacked size of an NPZ archive: a small archive of zeros may be a thousand times as large unpacked.
    npz_bytes: int = 2**30
    # [rad, rad/s, Nm; m, m/s, N] Largest magnitude of a signal; larger values have a wrong unit.
    largest_value: float = 1e9
    # [s] Largest time. Splines and divided differences (`noise_level`) multiply up to six time differences. The product
    # is then at most 1e144, far below the largest floating-point number.
    latest: float = 1e24
    # [s] Shortest time between samples. The product of six time steps (see `latest`) is then at least 1e-90, far above
    # the smallest floating-point number.
    shortest_step: float = 1e-15
    # [1] A step of a signal that exceeds this multiple of the typical step is a jump. A value of 0 between samples
    # whose magnitudes exceed the same multiple of the typical step is a lost sample: continuous signals approach 0
    # gradually.
    jump: float = 20.0
    # [1] Number of samples on each side of an outlier with which the outlier is compared.
    jump_window: int = 8
    # [1] A time step longer than this multiple of the median step is a gap; the jitter of USB loggers stays below 3.
    gap: float = 4.0
    # [Hz] Default cutoff of the low-pass filter: in logs of a UR10e, rigid-body motion has lower frequencies, and
    # torque ripple and quantisation noise have higher ones.
    automatic_cutoff: float = 8.0
    # [1] Smallest number of samples per period of the filter's cutoff frequency; Nyquist's bound is two.
    samples_per_period: int = 3
    # [Hz] Logs below this sample rate are interpolated by cubic instead of linear functions. Windows of logs at this
    # rate or below are not filtered by default.
    dense_rate: float = 50.0
    # [1] Largest number of lines below the last row of a CSV file, such as a summary; more lines are damaged rows.
    ending: int = 20
    # [1] Largest number of columns or times that a message lists.
    listed: int = 5


@dataclass(frozen=True)
class SignalCheckTuning:
    """Thresholds that several checks of logs use."""

    # [1] Two signals count as proportional if their correlation is at least this number. The factor between two
    # proportional signals counts as 1 if it is 1 +- 0.1, with 0.1 = 1 minus this number.
    agreement: float = 0.9
    # [rad, m] A joint is at rest in a log if the range of its positions is at most this number: noise of an encoder is
    # smaller.
    rest_range: float = 1e-3
    # [1] Number of samples over which the changes of q and of the integral of qd are compared. Between neighbouring
    # samples the quantisation step of q may be larger than the change of q.
    increments: int = 10
    # [s] Shorter delays of velocities relative to positions are not reported, since they are due to the filters of
    # drives.
    longest_lag: float = 0.03
    # [s] Smallest plausible median time between samples: no arm is sampled above 10 kHz.
    fastest_step: float = 1e-4
    # [s] Largest plausible median time between samples: no arm is sampled below 2 Hz.
    slowest_step: float = 0.5


@dataclass(frozen=True)
class SampleTuning:
    """Constants of the samples, filtered and at a common rate, to which dynamics are fitted."""

    # [rad/s, m/s] A joint is at rest at a sample if its speed is at most this number. Samples at which all joints are
    # at rest are omitted.
    moving: float = 0.02


TUNING, SIGNALS, SAMPLES = LogTuning(), SignalCheckTuning(), SampleTuning()

# [Hz] Lowest sample rate of logs from which accelerations are computed.
SLOWEST = TUNING.samples_per_period * TUNING.automatic_cutoff
# [1] Tolerance of comparisons with a sample rate: loggers with a nominal rate of 50 Hz have measured rates between
# 49.95 Hz and 50.1 Hz.
FAST = 1.002


def shows_accelerations(rate: float) -> bool:
    """Return True if accelerations can be computed from logs of this sample rate [Hz]: it must be at least 24 Hz."""
    return rate * FAST >= SLOWEST


def is_dense(rate: float) -> bool:
    """Return True if linear interpolation between samples suffices at this sample rate [Hz]: at least 50 Hz."""
    return rate * FAST >= TUNING.dense_rate
