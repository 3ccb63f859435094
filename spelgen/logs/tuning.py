"""Constants of reading, checking and preparing logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogTuning:
    """Reading, cutting, filtering and differentiation of logs."""

    # [B] Numbers that a fit keeps of all logs together: 25 minutes of seven joints at 1 kHz, or 76,000 samples of a
    # torque fit, about the number that its last iterations use. Windows of five samples take five times the memory.
    kept_bytes: int = 2**28
    # [1] Largest number of samples of a segment of logs that exceed `kept_bytes`: 16 s at 1 kHz, long compared with
    # filter transients.
    segment_samples: int = 2**14
    # [1] Rows of a row group of the Parquet files that are written.
    row_group: int = 2**16
    # [B] Largest unpacked size of an NPZ archive: zeros are packed a thousandfold.
    npz_bytes: int = 2**30
    # [rad, rad/s, Nm; m, m/s, N] Largest magnitude of a signal; larger ones have a wrong unit.
    largest_value: float = 1e9
    # [1] A step that exceeds this multiple of the typical step is a jump, and a 0 between samples whose magnitudes
    # exceed it is a missing value: continuous signals approach 0 gradually.
    jump: float = 20.0
    # [1] An outlier's two steps exceed this multiple of the steps of its neighbours: a fast motion has large steps
    # before and after, too.
    local_jump: float = 4.0
    # [1] Samples on each side of an outlier that are its neighbours.
    jump_window: int = 8
    # [1] Largest number of samples of an outlier: a signal that returns later has jumped.
    excursion: int = 5
    # [1] Largest fraction of jumps among the steps; a signal with more is noisy.
    most_jumps: float = 0.05
    # [1] Largest fraction of steps at which a signal about 0, and with it the sign bit of its words, changes its sign.
    most_words: float = 0.5
    # [1] Smallest step of words relative to the range of a signal: words of 18 bits.
    finest_word: float = 4e-6
    # [1] Largest rounding error of values on a grid, relative to its step.
    word_rounding: float = 0.02
    # [1] Largest excess of a wrapped angle over its period by noise, relative to the period.
    word_margin: float = 0.01
    # [rad/s, m/s] Largest velocity of an arm: a faster step is a jump.
    fastest: float = 40.0
    # [rad] Difference from one revolution within which a period is one revolution.
    limit_of_turn: float = 1e-6
    # [1] Fraction of repeated rows up to which they have no effect on a fit.
    repeats: float = 0.02
    # [1] Number of rows with equal times and different values up to which they are accidental.
    few_repeats: int = 10
    # [1] Fraction of rows with equal times and different values above which the clock is too coarse.
    coarse_clock: float = 0.02
    # [1] A step longer than this multiple of the median step is a gap; jitter of USB loggers stays below 3.
    gap: float = 4.0
    # [Hz] Cutoff of the low-pass filter by default: rigid-body motion lies below, ripple and quantisation above
    # (UR10e).
    automatic_cutoff: float = 8.0
    # [Hz] Logs of a lower rate are interpolated by cubics, and their windows are not filtered.
    dense_rate: float = 50.0
    # [1] Relative error of a sample rate: nominal 50 Hz are 49.95 Hz with one logger and 50.1 Hz with another.
    clock_error: float = 0.002
    # [1] Order of the Butterworth low-pass, run forward and backward as in the logs' published protocols.
    filter_order: int = 4
    # [1] Smallest number of samples per period of the cutoff; Nyquist's bound is two.
    samples_per_period: int = 3
    # [s] Span of the cubic that differentiates encoder positions: a trade-off of noise and lag (SO-101).
    derivative_span: float = 0.18
    # [1] Largest first time of a clock that starts with the recording, in any unit of time; a larger one is a date.
    longest_clock: float = 1e8
    # [1] Number of bins of the histograms of coverage.
    bins: int = 24
    # [B] Size of the head of a CSV file from which encoding, delimiter and decimal point are detected.
    csv_head: int = 2**16
    # [1] Largest number of columns in a message.
    listed: int = 5
    # [s] Shortest time between samples, so that its fourth power does not underflow.
    shortest_step: float = 1e-15
    # [s] Largest time, so that its fourth power does not overflow.
    latest: float = 1e24


@dataclass(frozen=True)
class SignalCheckTuning:
    """Thresholds of the checks of the signals of a log."""

    # [1] Number of samples over which q and the integral of qd are compared, to average out quantisation.
    increments: int = 10
    # [rad, m] Integral of qd above which a constant q is frozen.
    drift: float = 0.05
    # [1] Correlation from which on two signals are proportional; 1 minus it is the tolerance of a factor of 1.
    agreement: float = 0.9
    # [1] Tolerance of the factor of a unit: its ratio to a measured factor is at most this number, or its inverse.
    unit_factor: float = 1.25
    # [s] Smallest and largest median time between samples: no arm is sampled above 10 kHz or below 2 Hz.
    fastest_step: float = 1e-4
    slowest_step: float = 0.5
    # [1] Largest velocity of the rarer sign, relative to the largest velocity, of a signal without sign.
    unsigned: float = 0.05
    # [1] Smallest correlation of a velocity without sign with the magnitude of dq/dt.
    unsigned_agreement: float = 0.9
    # [1] Largest distance of decoded commands from positions, relative to the distance of undecoded ones.
    near_position: float = 0.3


@dataclass(frozen=True)
class SampleTuning:
    """Samples of the dynamics: filtered, and on a common grid of time."""

    # [Hz] Rate of the common grid: twelve times the cutoff of the low-pass filter.
    sample_rate: float = 100.0
    # [rad/s, m/s] A joint is at rest below this speed; samples of an arm at rest determine no dynamics.
    moving: float = 0.02
    # [s] Shortest gap-free piece: shorter ones consist of filter transients.
    shortest_piece: float = 1.0
    # [1] Length of the transient at both ends of a piece, in periods of the cutoff; the filter's error there is 20
    # times the noise.
    unsettled: float = 0.75


@dataclass(frozen=True)
class ServoRolloutTuning:
    """Integration of motion under position servos."""

    # [s] Largest integration step; longer ones bias armatures by a few per cent (measured).
    step: float = 3.4e-3


@dataclass(frozen=True)
class ResonanceTuning:
    """Detection of elastic joints. Recorded arms: see benchmarks; none of them shows a resonance."""

    # [s] Length of a segment: its inverse is the resolution in frequency.
    segment: float = 2.0
    # [1] Smallest number of segments of a recording.
    segments: int = 4
    # [Hz] Evaluated band: below, gravity and friction dominate; links of arms have resonances between 3 and 30 Hz.
    lowest: float = 0.9
    highest: float = 30.0
    # [1] Number of logarithmic bands in it, and the smallest number of coherent bands.
    bands: int = 25
    fewest_bands: int = 5
    # [1] Smallest squared in-phase coherence of a band, and its smallest power relative to the strongest band.
    coherence: float = 0.85
    excited: float = 1e-3
    # [1] Number of candidate resonances, and their largest multiple of the highest excited frequency.
    candidates: int = 120
    beyond: float = 1.5
    # [1] Smallest relative error of the rigid model, and largest one of the elastic model, of the apparent inertia.
    rigid_error: float = 0.1
    elastic_error: float = 0.06
    # [1] Smallest inertia of the link relative to the motor's.
    smallest_link: float = 0.1
    # [1] Relative increase of the apparent inertia up to which the rigid model is valid.
    valid: float = 0.1


TUNING, SIGNALS, SAMPLES = LogTuning(), SignalCheckTuning(), SampleTuning()
SERVO_ROLLOUT, RESONANCE = ServoRolloutTuning(), ResonanceTuning()
