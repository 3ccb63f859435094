"""Constants of reading, checking and preparing logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogTuning:
    """Numbers that decide how logs are read, cut, filtered and differentiated."""

    in_memory: int = 100_000_000  # [bytes] of numbers above which logs are streamed; windows take five times
    chunk_samples: int = 2**16  # of a streamed log held at once: of 7 joints 12 MB, as windows 53 MB
    npz_bytes: int = 2**30  # unpacked at most from one NPZ archive, which zeros pack a thousandfold
    largest_value: float = 1e9  # [rad, rad/s, Nm; m, m/s, N] no arm has more: what is beyond is a wrong unit
    # [usual steps] A larger step is a jump, and a 0 with neighbours farther away is a missing value.
    jump: float = 20.0
    # [steps of the neighbours] An outlier's two steps are larger: a fast motion has large steps before and after, too.
    local_jump: float = 4.0
    jump_window: int = 8  # [samples] of the neighbours on each side
    excursion: int = (
        5  # [samples] A signal that leaves and returns within these has outliers, later it has jumped.
    )
    most_jumps: float = 0.05  # of all steps: a signal with more is noise
    most_words: float = 0.5  # of all steps: a signal around 0 changes its sign, and a sign bit, no more often
    finest_word: float = 4e-6  # of the range of a signal: steps of words of 18 bits
    word_rounding: float = 0.02  # [steps] by which values on a grid may be rounded
    word_margin: float = 0.01  # of a period, by which the noise of an angle exceeds it
    fastest: float = 40.0  # [rad/s, m/s] No arm moves faster, so a faster step is a jump.
    limit_of_turn: float = 1e-6  # [rad] A period as close to a turn is one.
    few_repeats: int = 10  # rows of one time, but different states, that are an accident
    coarse_clock: float = 0.02  # of all rows: from here on the clock is too coarse
    gap: float = 4.0  # [median steps] a longer step is a hole; jitter of USB loggers stays below 3
    automatic_cutoff: float = 8.0  # [Hz] rigid-body motion lies below, ripple and quantisation above (UR10e)
    # [Hz] slower logs are interpolated by cubics, and windows of them are not filtered
    dense_rate: float = 50.0
    clock_error: float = 0.002  # of a rate: nominal 50 Hz are 49.95 Hz of one logger, 50.1 Hz of another
    filter_order: int = 4  # of the Butterworth low-pass, run both ways: as in the logs' published protocols
    samples_per_period: int = 3  # of the cutoff's period that windows keep; two are Nyquist's bound
    derivative_span: float = 0.18  # [s] of the cubic through encoder positions (SO-101: noise against lag)
    longest_clock: float = 1e8  # in whatever unit of time: no recording begins so late on a clock of its own
    bins: int = 24  # bars of a chart of what logs cover
    csv_head: int = 2**16  # [bytes] from which encoding, delimiter and decimal point are detected
    listed: int = 5  # columns that a message names: enough to see how they are named
    shortest_step: float = 1e-15  # [s] that a log can have: fourth powers of it are still numbers
    latest: float = 1e24  # [s] likewise, of a time


@dataclass(frozen=True)
class SignalCheckTuning:
    """Thresholds of the checks of the signals of a log."""

    increments: int = 10  # [samples] over which q and the integral of qd are compared: hides quantisation
    drift: float = 0.05  # [rad, m] that qd must say a joint moved, before a constant q is called frozen
    agreement: float = 0.9  # correlation from which two signals are one; their factor may differ by the rest
    unit_factor: float = 1.25  # a factor this near to that of a unit is that of the unit
    fastest_step: float = 1e-4  # [s] nor faster than at 10 kHz
    slowest_step: float = 0.5  # [s] no arm is sampled more slowly than at 2 Hz
    unsigned: float = 0.05  # of the fastest velocity: one that is the magnitude of another is hardly below 0
    unsigned_agreement: float = 0.9  # correlation of a magnitude with |dq/dt|
    repeats: float = (
        0.01  # of all rows: fewer repeats are an oversight of the logger, without effect on a fit
    )
    near_position: float = (
        0.3  # of the distance of commands from positions, that remains when words are read rightly
    )


@dataclass(frozen=True)
class SampleTuning:
    """Constants of the samples of dynamics."""

    sample_rate: float = 100.0  # [Hz] of the common grid: twelve times the low-pass, as is usual
    moving: float = 0.02  # [rad/s, m/s] joints that are slower rest, and say nothing of dynamics
    shortest_piece: float = 1.0  # [s] shorter pieces are all filter transient
    # [periods of the filter's cutoff] at both ends of a piece, where the filter is off by 20 times what noise is
    unsettled: float = 0.75


@dataclass(frozen=True)
class ServoRolloutTuning:
    """Decide how finely motion under servos is integrated."""

    step: float = 3.4e-3  # [s] at most; measured: longer steps bias armatures by a few percent


TUNING, SIGNALS, SAMPLES = LogTuning(), SignalCheckTuning(), SampleTuning()
SERVO_ROLLOUT = ServoRolloutTuning()
