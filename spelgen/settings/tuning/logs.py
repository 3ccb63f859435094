"""Hold the tuned numbers of reading and preparing logs."""

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
    excursion: int = 5  # [samples] A signal that leaves and returns within these has outliers, later it has jumped.
    most_jumps: float = 0.05  # of all steps: a signal with more is noise
    most_words: float = 0.5  # of all steps: a signal around 0 changes its sign, and a sign bit, no more often
    fastest: float = 40.0  # [rad/s, m/s] No arm moves faster, so a faster step is a jump.
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


TUNING = LogTuning()
