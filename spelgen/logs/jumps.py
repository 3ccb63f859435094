"""Detection of jumps of logged signals: lost samples, outliers, wrapped angles, register words, repeated rows.

The functions apply to one signal (T,) or to a log of C columns (T, C), of any format and any robot. A step is the
difference between neighbouring samples; the typical step is the median magnitude of the steps, without zeros and
rounding errors. Register words are the raw integers of a drive's register: they overflow at a period, or have a bit for
the sign.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from spelgen.logs.tuning import TUNING
from spelgen.settings.log_mapping import Decoding

# Register words of drives have at most 18 bits, so their step is at least 2^-18 = 4e-6 of their range. Smaller steps of
# a signal are rounding errors.
FINEST_WORD = 4e-6
# A signal with fewer values is not decoded: its median step might itself be a jump.
FEWEST = 4


def jump_count(values: np.ndarray, period: float) -> int:
    """Return the number of wraps of a signal (T,): jumps of more than half a period between two samples."""
    return int(np.count_nonzero(np.abs(np.diff(values)) > period / 2))


def unwrapped(values: np.ndarray, period: float) -> np.ndarray:
    """Return the continuous signal for a signal (T,) that wraps at a period; the first value is unchanged."""
    if not jump_count(values, period):
        return values
    turns = np.diff(values, prepend=values[:1]) / period
    whole = np.round(turns)
    # Two opposite steps of about half a period are an outlier of one sample. Their sum is rounded to whole periods:
    # rounded separately, the two steps would shift all later samples by a period.
    is_half = np.abs(np.abs(turns) - 0.5) < 0.25
    rows = np.flatnonzero(is_half[:-1] & is_half[1:] & (turns[:-1] * turns[1:] < 0))
    whole[rows], whole[rows + 1] = 0.0, np.round(turns[rows] + turns[rows + 1])
    return values - period * np.cumsum(whole)


def centred(values: np.ndarray, period: float) -> np.ndarray:
    """Return a signal (T,) shifted by whole periods, so that its median is at most half a period from 0."""
    return np.asarray(values - period * np.round(np.median(values) / period))


def signed(words: np.ndarray, sign_bit: float) -> np.ndarray:
    """Return the numbers that sign-magnitude words (T,) represent: a word w >= sign_bit is sign_bit - w."""
    return np.where(words >= sign_bit, sign_bit - words, words)


def decoded(words: np.ndarray, key: Decoding, size: float) -> np.ndarray:
    """Return the numbers (T,) that register words (T,) represent.

    key "sign_bit": a word w >= size represents size - w. key "period": words wrap at the period `size`; the wraps are
    removed, and the median of the signal is shifted to within half a period of 0. Size and words have the same unit.
    """
    return signed(words, size) if key == "sign_bit" else centred(unwrapped(words, size), size)


def is_lost(values: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of lost samples, for which loggers write exactly 0 between values far from 0."""
    lost = np.zeros(len(values), bool)
    logged = np.flatnonzero(values)
    if not logged.size or logged[-1] - logged[0] == len(logged) - 1:
        return lost  # Zeros only at the ends of a signal are not lost samples: the arm may have been at rest.
    steps = np.abs(np.diff(values[logged]))
    # Zeros between samples close to 0 are not lost samples: a continuous signal may pass through 0.
    nearest = np.minimum(np.abs(values[logged[:-1]]), np.abs(values[logged[1:]]))
    lost[logged[0] : logged[-1]] = np.repeat(nearest > TUNING.jump * _typical_step(steps), np.diff(logged))
    return np.asarray(lost & (values == 0))


def is_outlier(values: np.ndarray, *, smooth: bool) -> np.ndarray:
    """Return a mask (T,) of the samples that are lost (see `is_lost`) or outliers.

    An outlier is one of at most five samples between two opposite jumps. Torques and velocities may have genuine steps:
    their outliers must also lie outside the range of all other samples by more than half of this range.

    smooth: True for positions, which change gradually; False for torques and velocities.
    """
    outliers = is_lost(values)
    if len(values) < TUNING.jump_window:
        return outliers
    steps = np.diff(values)
    sizes = np.abs(steps)
    largest_step = TUNING.jump * _typical_step(sizes)
    logged = np.flatnonzero(values)
    # Zeros at the beginning or end of positions are lost samples if the neighbouring position is far from 0. Torques
    # and velocities may be 0 there.
    if smooth and len(logged) > TUNING.jump_window:
        first, last = logged[[0, -1]]
        outliers[:first] |= abs(values[first]) > largest_step
        outliers[last + 1 :] |= abs(values[last]) > largest_step
    is_jump = sizes > largest_step
    # A signal in which more than 5 % of the steps are jumps is noisy: it has no outliers except lost samples.
    if not is_jump.any() or is_jump.mean() > 0.05:
        return outliers
    rows = np.flatnonzero(is_jump)
    first, last, window = rows[0], rows[-1], TUNING.jump_window
    # One or two outliers at the beginning or end of a recording cause only one jump, since there is no signal on their
    # other side.
    if first < 2 and sizes[first] > 4.0 * sizes[first + 1 : first + 1 + window].max():
        outliers[: first + 1] = True
    if last > len(sizes) - 3 and sizes[last] > 4.0 * sizes[last - window : last].max():
        outliers[last + 1 :] = True
    for first, second in pairwise(rows):
        out, back = steps[first], steps[second]
        # `is_excursion`: an excursion consists of two opposite jumps of similar size, with at most five samples between
        # them. If a signal returns only after more samples, its two jumps may be genuine, and there is no outlier.
        is_excursion = out * back < 0 and 0.5 < abs(out / back) < 2 and second - first <= 5
        if not is_excursion:
            continue
        low, high = max(0, first - window), second + 1 + window
        # An excursion is an outlier only if its jumps are four times as large as the neighbouring steps, which are
        # large during fast motion. The two largest neighbouring steps are ignored, since they may belong to another
        # outlier.
        around = np.sort(np.concatenate([sizes[low:first], sizes[second + 1 : high]]))[:-2]
        if min(abs(out), abs(back)) > 4.0 * around.max(initial=0.0):
            outliers[first + 1 : second + 1] = True
    if smooth or not outliers.any():
        return outliers
    inliers = values[~outliers]
    margin = np.ptp(inliers) / 2
    is_beyond = (values > inliers.max() + margin) | (values < inliers.min() - margin) | is_lost(values)
    return np.asarray(outliers & is_beyond)


def is_stale(values: np.ndarray, changes: np.ndarray, min_change: float, margin: int = 0) -> np.ndarray:
    """Return a mask (T,) of stale samples: repetitions of an old value while the measured quantity must have changed.

    A block is a run of equal values. A block is stale, except for its first sample, if it meets these conditions:

    1. It has more than 20 times as many samples as the median block.
    2. The reference signal `changes` changes by more than `min_change` within the block, not counting the first and the
       last `margin` samples.
    3. If the signal is quantised, the step at the end of the block is larger than four times the median step between
       blocks: slow motion of a quantised signal also has long blocks, but these end with a step of one quantum.

    values: the signal (T,). changes: the reference signal (T,), for example the velocity of the joint for its torque.
    """
    stale = np.zeros(len(values), bool)
    starts, lengths, is_long = _blocks(values)
    if not is_long.any():
        return stale
    steps = np.append(np.abs(np.diff(values[starts])), np.inf)
    is_quantised = len(np.unique(values)) < len(starts) / 2
    is_long &= (steps > 4.0 * _typical_step(steps[:-1]) * is_quantised) & (len(starts) > 1)
    for start, length in zip(starts[is_long], lengths[is_long], strict=True):
        inside = changes[start + 1 + margin : start + length - margin]
        if inside.size and np.ptp(inside) > min_change:
            stale[start + 1 : start + length] = True
    return stale


def is_interrupted(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of the samples of a position q (T,) that repeat an old value, as the motion around them shows.

    A block is a run of equal positions with more than 20 times as many samples as the median block. It is stale, except
    for its first sample, if it meets two conditions:

    1. It ends with a jump by more than 0.05 rad or m, at more than twice the largest speed of the motion; or it is the
       last block.
    2. The motion before it stops within one step. This change of speed is above 0.05 rad/s or m/s, and three times as
       large as those away from blocks that meet the first condition.

    t: (T,) times [s].
    """
    stale = np.zeros(len(q), bool)
    starts, lengths, is_long = _blocks(q)
    is_long[0] = False
    if not is_long.any():
        return stale
    speeds = np.abs(np.diff(q)) / np.maximum(np.diff(t), np.median(np.diff(t)))
    start = starts[is_long]
    end = start + lengths[is_long]
    last = np.minimum(end, len(q) - 1)
    motion = np.delete(speeds, last - 1)
    jumps_back = (np.abs(q[last] - q[start]) > 0.05) & (speeds[last - 1] > 2 * motion.max(initial=0.0))
    is_open = jumps_back | (end == len(q))
    start, end = start[is_open], end[is_open]
    changes = np.abs(np.diff(speeds))
    stops = changes[start - 1]
    edges = np.concatenate([start - 1, end - 2, end - 1])
    changes[edges[edges < len(changes)]] = 0.0
    for first, stop, change in zip(start, end, stops, strict=True):
        stale[first + 1 : stop] = change > max(3 * changes.max(initial=0.0), 0.05)
    return stale


def jumps(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the indices of the samples after which a position q (T,) [rad, m] at times t (T,) [s] jumps.

    A jump is a step that is faster than any arm, and more than 20 times the typical step. Steps across gaps in time are
    no jumps, since the arm may have moved in the gap.
    """
    if len(q) < TUNING.jump_window:
        return np.zeros(0, int)
    sizes, dt = np.abs(np.diff(q)), np.diff(t)
    median = float(np.median(dt))
    is_jump = (sizes > TUNING.jump * _typical_step(sizes)) & (dt <= TUNING.gap * median)
    # No arm is faster than 40 rad/s or m/s. A step is assumed to last at least the median time step, since messages
    # that arrive in bursts have time stamps that are too close to each other.
    return np.flatnonzero(is_jump & (sizes > 40.0 * np.maximum(dt, median)))


def repeated_rows(columns: np.ndarray, positions: int) -> tuple[np.ndarray, int]:
    """Return a mask (T,) of the repeated rows of a log (T, C) with C columns, and the number of copies of each row.

    A logger may write each row m times. A block is a run of k equal rows, of one of two kinds:

    1. The arm moved, and all rows after the first are repeats. Such a block is recognised by the position step at its
       end, which is as large as k normal steps. Example: in the positions 1, 1, 1, 4, 5, the first three rows are a
       block with k = 3, and the step from 1 to 4 makes up for the repeats. The number of copies m is the median of k
       over all blocks of this kind, or 1 if there are none.
    2. Otherwise the arm was at rest: every m-th row of the block is original, and the rows between are repeats.

    positions: number of leading columns that are positions.
    """
    starts = np.flatnonzero(np.append(True, (np.diff(columns, axis=0) != 0).any(axis=1)))
    lengths = np.diff(np.append(starts, len(columns)))
    is_held = np.zeros(len(starts), bool)
    index = np.arange(len(columns)) - np.repeat(starts, lengths)
    if len(starts) < 4 or not index.any():
        return np.repeat(is_held, lengths), 1
    # `steps`: step of each position at the end of each block of equal rows; the last block has no step.
    steps = np.abs(np.diff(columns[starts, :positions], axis=0))
    speeds = steps[1:] / lengths[1:-1, None]
    quantum = np.min(np.where(steps > 0, steps, np.inf), axis=0)
    makes_up = (steps[:-1] > 2.5 * quantum) & (steps[:-1] > 0.6 * lengths[:-2, None] * speeds)
    is_held[:-2] = makes_up.any(axis=1)
    often = int(np.median(lengths[is_held])) if is_held.any() else 1
    repeats = np.repeat(is_held, lengths) & (index > 0)
    return repeats | (index % often != 0), often


def held_samples(values: np.ndarray) -> int:
    """Return the number of consecutive rows in which a logger repeats each value of a signal (T,); normally 1."""
    # a short signal is omitted first, which saves time for logs of many short recordings
    if len(values) <= TUNING.jump_window:
        return 1
    changes = np.flatnonzero(np.diff(values))
    if len(changes) < TUNING.jump_window:
        return 1
    sizes = np.abs(np.diff(values)[changes])
    # Only blocks of equal samples that end with a change by several quantisation steps are counted. In a slow quantised
    # signal, blocks that end with a single quantisation step are genuine.
    large = sizes[1:] > 2.5 * sizes.min()
    if large.sum() < TUNING.jump_window:
        return 1
    return int(np.median(np.diff(changes)[large]))


class Word(NamedTuple):
    """Decoding of a logged signal as register words, the raw integers of a drive's register.

    Attributes:
        key: setting of the mapping that decodes the signal: "period", at which words overflow, or "sign_bit", the value
            of the bit that marks negative numbers.
        value: period or sign bit in the unit of the log.
        values: (T,) decoded signal in the unit of the log.
    """

    key: Decoding
    value: float
    values: np.ndarray


def read_as_words(values: np.ndarray, turn: float | None) -> Word | None:
    """Return the decoding of a signal as register words if a decoding removes at least half of its jumps; else None.

    Candidates are words with a bit for the sign and words that overflow at a period. The value of the sign bit or the
    period is 2^k revolutions or 2^k quantisation steps, with a whole number k. The decoding with the fewest remaining
    jumps is returned; of several with equally few jumps, the one with the smoothest signal.

    values: (T,) in the unit of the log. turn: one revolution in this unit; None for a joint that does not rotate.
    """
    if len(values) < FEWEST:
        return None
    steps = np.diff(values)
    limit = 0.4 * float(np.ptp(values))
    rows = np.flatnonzero(np.abs(steps) > limit)
    # A change of the sign bit, or an overflow, is a jump. In register words at most half of the steps are jumps: even
    # the sign of noise about 0 changes only at half of the steps. A signal with more jumps has another fault.
    if not len(rows) or len(rows) > 0.5 * len(values):
        return None
    jump, typical = float(np.median(np.abs(steps[rows]))), _typical_step(np.abs(steps))
    # Torques may reverse abruptly, so a jump of a signal with negative values counts as an overflow only if it is
    # nearly as large as the range of the signal.
    is_signed = values.min() < -FINEST_WORD * np.ptp(values)
    if is_signed and jump < max(0.9 * np.ptp(values), TUNING.jump * typical):
        return None
    sizes = [x for x in _word_sizes(values, turn) if 0.75 < x / jump < 1.35]
    around = np.unique(np.clip(rows[:, None] + np.arange(-2, 3), 0, len(steps) - 1))
    best, best_score = None, (len(rows) / 2, np.inf)
    is_whole = bool((values == values.round()).all())
    for size in sizes:
        # `readings`: possible decodings. If words overflow at a period, their range is at most this period (plus 1 %
        # for noise, if they are not whole numbers). If words have a sign bit, values from the sign bit on represent
        # negative numbers, so such values must occur.
        readings = []
        if np.ptp(values) < (size if is_whole else 1.01 * size):
            readings.append(Word("period", size, decoded(values, "period", size)))
        if not is_signed and values.max() >= size:
            readings.append(Word("sign_bit", size, signed(values, size)))
        for reading in readings:
            jumps = np.abs(np.diff(reading.values))
            # A decoding is rejected if the decoded signal still has large steps at the rows of the logged jumps. These
            # jumps were then caused by the motion, and not by overflows or changes of sign.
            if np.median(jumps[rows]) > TUNING.jump * typical:
                continue
            bends = np.abs(np.diff(reading.values, 2))
            score = (
                float(np.count_nonzero(jumps > limit)),
                float(bends[np.clip(around, 0, len(bends) - 1)].sum()),
            )
            if score < best_score:
                best, best_score = reading, score
    return best


def _word_sizes(values: np.ndarray, turn: float | None) -> list[float]:
    """Return candidates for the size of register words, the value at which they overflow or of their sign bit.

    Drives have words of 2^k steps (k = 10 to 17) or of 2^k revolutions (k = 0 to 8). A step is the quantisation step of
    ``values``, the signal (T,) in the unit of the log. turn: one revolution in this unit; None if the joint does not
    rotate.
    """
    sizes = [] if turn is None else [turn * 2.0**k for k in range(9)]
    levels = np.unique(values)
    differences = np.diff(levels)
    # Differences below the fraction `FINEST_WORD` of the signal's range are rounding errors: the values were converted
    # to SI units and back.
    differences = differences[differences > FINEST_WORD * np.ptp(values)]
    if differences.size:
        step = float(differences.min())
        numbers = (values - levels[0]) / step  # zero may lie between two steps
        if np.abs(numbers - np.round(numbers)).max() < 0.02:
            sizes += [step * 2.0**k for k in range(10, 18)]
    return sizes


def _blocks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the starts and lengths of the runs of equal values of a signal (T,), and a mask of the long runs.

    A run is long if it has more than 20 times as many samples as the median run.
    """
    starts = np.flatnonzero(np.diff(values, prepend=np.nan))
    lengths = np.diff(np.append(starts, len(values)))
    return starts, lengths, lengths > 20.0 * max(1.0, float(np.median(lengths)))


def _typical_step(sizes: np.ndarray) -> float:
    """Return the typical step of a signal: the median of its step sizes (T,), without zeros and rounding errors.

    A step below 1e-9 times a large step is a rounding error. Example: a velocity that was computed from encoder
    positions at rest is 1e-14 instead of 0. The result is infinity if all sizes are zero.
    """
    moving = np.sort(sizes[sizes > 0])
    if not moving.size:
        return np.inf
    # The 90 % quantile is a normal step also if single outliers are larger by many orders of magnitude.
    smallest = 1e-9 * moving[int(0.9 * (len(moving) - 1))]
    return float(np.median(moving[np.searchsorted(moving, smallest) :]))
