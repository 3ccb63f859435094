"""Detection of jumps of logged signals: lost samples, outliers, wrapped angles, register words, repeated rows.

Every function takes one signal (T,) or the columns of a log (T, C), of any format and any robot. A step is the
difference between neighbouring samples, the typical step the median of the steps that are not 0.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from spelgen.logs.tuning import TUNING

FINEST_WORD = 4e-6  # smallest step of words relative to the range of a signal: words of 18 bits


def jump_count(values: np.ndarray, period: float) -> int:
    """Return the number of steps of a signal (T,) that are longer than half a period."""
    return int(np.count_nonzero(np.abs(np.diff(values)) > period / 2))


def unwrapped(values: np.ndarray, period: float) -> np.ndarray:
    """Return the signal (T,) without jumps of whole periods."""
    if not jump_count(values, period):
        return values
    steps = np.diff(values, prepend=values[:1])
    return np.asarray(values - period * np.cumsum(np.round(steps / period)))


def centred(values: np.ndarray, period: float) -> np.ndarray:
    """Return the signal (T,) shifted by whole periods, so that its median is at most half a period from 0."""
    return np.asarray(values - period * np.round(np.median(values) / period))


def signed(words: np.ndarray, sign_bit: float) -> np.ndarray:
    """Return the numbers that sign-magnitude words (T,) represent: words from `sign_bit` on are negative."""
    return np.where(words >= sign_bit, sign_bit - words, words)


def is_lost(values: np.ndarray) -> np.ndarray:
    """Return a mask (T,) of samples that are exactly 0 between samples far from 0: missing values of loggers."""
    lost = np.zeros(len(values), bool)
    logged = np.flatnonzero(values)
    if not logged.size or logged[-1] - logged[0] == len(logged) - 1:
        return lost  # zeros occur only at the ends, where the signal itself may be zero
    steps = np.abs(np.diff(values[logged]))
    # a signal that passes through 0 has samples close to 0 first
    nearest = np.minimum(np.abs(values[logged[:-1]]), np.abs(values[logged[1:]]))
    lost[logged[0] : logged[-1]] = np.repeat(nearest > TUNING.jump * _usual(steps), np.diff(logged))
    return np.asarray(lost & (values == 0))


def is_outlier(values: np.ndarray, *, smooth: bool) -> np.ndarray:
    """Return a mask (T,) of lost samples and of outliers.

    smooth: True for positions, whose steps change gradually. Torques and velocities may have steps: their outliers
    must also exceed the range of all other samples by half of it.
    """
    outliers = is_lost(values)
    if len(values) < TUNING.jump_window:
        return outliers
    steps = np.diff(values)
    sizes = np.abs(steps)
    is_jump = sizes > TUNING.jump * _usual(sizes)
    # a signal with more large steps is noisy
    if not is_jump.any() or is_jump.mean() > 0.05:
        return outliers
    for first, second in pairwise(np.flatnonzero(is_jump)):
        out, back = steps[first], steps[second]
        # an outlier has at most five samples: a signal that returns later has jumped
        is_excursion = out * back < 0 and 0.5 < abs(out / back) < 2 and second - first <= 5
        if not is_excursion:
            continue
        low, high = max(0, first - TUNING.jump_window), second + 1 + TUNING.jump_window
        # a fast motion has large steps on both sides; the two largest steps may belong to another outlier
        around = np.sort(np.concatenate([sizes[low:first], sizes[second + 1 : high]]))[:-2]
        if min(abs(out), abs(back)) > 4.0 * around.max(initial=0.0):
            outliers[first + 1 : second + 1] = True
    if smooth or not outliers.any():
        return outliers
    inliers = values[~outliers]
    margin = np.ptp(inliers) / 2
    is_beyond = (values > inliers.max() + margin) | (values < inliers.min() - margin) | is_lost(values)
    return np.asarray(outliers & is_beyond)


def is_stale(values: np.ndarray, changes: np.ndarray, min_change: float) -> np.ndarray:
    """Return a mask (T,) of samples that repeat an old value for long, in a signal that otherwise changes.

    The step to the value after them is large: quantised signals, and drives with a dead zone, go on with a typical one.
    changes: (T,), a signal that cannot change by more than `least` while the values are constant.
    """
    stale = np.zeros(len(values), bool)
    starts = np.flatnonzero(np.diff(values, prepend=np.nan))
    lengths = np.diff(np.append(starts, len(values)))
    steps = np.append(np.abs(np.diff(values[starts])), np.inf)
    is_long = lengths > 20.0 * max(1.0, float(np.median(lengths)))
    is_long &= (steps > 4.0 * _usual(steps[:-1])) & (len(starts) > 1)
    for start, length in zip(starts[is_long], lengths[is_long], strict=True):
        rows = slice(start + 1, start + length)
        if np.ptp(changes[rows]) > min_change:
            stale[rows] = True
    return stale


def jumps(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the rows after which a position (T,) jumps: faster than any arm, and than typical steps.

    Steps across gaps in time are not jumps: the arm may have moved in the gap.
    """
    if len(q) < TUNING.jump_window:
        return np.zeros(0, int)
    sizes, dt = np.abs(np.diff(q)), np.diff(t)
    median = float(np.median(dt))
    is_jump = (sizes > TUNING.jump * _usual(sizes)) & (dt <= TUNING.gap * median)
    # no arm is faster than 40 rad/s, m/s; time stamps may come in bursts: a step lasts at least the median time
    return np.flatnonzero(is_jump & (sizes > 40.0 * np.maximum(dt, median)))


def repeated_rows(columns: np.ndarray, positions: int) -> tuple[np.ndarray, int]:
    """Return a mask (T,) of the rows of a log (T, C) that repeat the row before during motion, and the copies of each
    row.

    positions: number of leading columns that are positions. Equal rows count as repeats if the motion continued
    meanwhile: the step after k equal rows is as large as k steps of the motion after it. Rows of an arm at rest are
    kept; if rows of a motion are written n times, one of n rows at rest is kept.
    """
    starts = np.flatnonzero(np.append(True, (np.diff(columns, axis=0) != 0).any(axis=1)))
    lengths = np.diff(np.append(starts, len(columns)))
    is_held = np.zeros(len(starts), bool)
    index = np.arange(len(columns)) - np.repeat(starts, lengths)
    if len(starts) < 4 or not index.any():
        return np.repeat(is_held, lengths), 1
    # after each block of equal rows except the last
    steps = np.abs(np.diff(columns[starts, :positions], axis=0))
    speeds = steps[1:] / lengths[1:-1, None]
    quantum = np.min(np.where(steps > 0, steps, np.inf), axis=0)
    makes_up = (steps[:-1] > 2.5 * quantum) & (steps[:-1] > 0.6 * lengths[:-2, None] * speeds)
    is_held[:-2] = makes_up.any(axis=1)
    often = int(np.median(lengths[is_held])) if is_held.any() else 1
    repeats = np.repeat(is_held, lengths) & (index > 0)
    return repeats | (index % often != 0), often


def held_samples(values: np.ndarray) -> int:
    """Return the number of samples for which each value of a changing signal (T,) is held: 1 for a faultless signal."""
    changes = np.flatnonzero(np.diff(values))
    if len(changes) < TUNING.jump_window:
        return 1
    sizes = np.abs(np.diff(values)[changes])
    # slow quantised signals are constant for several samples without being held: only large steps count
    large = sizes[1:] > 2.5 * sizes.min()
    if large.sum() < TUNING.jump_window:
        return 1
    return int(np.median(np.diff(changes)[large]))


class Word(NamedTuple):
    """Decoding of a signal as register words.

    key, value: of the mapping, in logged units. jumps: number of jumps of the signal. values: the decoded signal.
    """

    key: str
    value: float
    jumps: int
    values: np.ndarray


def read_as_words(values: np.ndarray, turn: float | None) -> Word | None:
    """Return the decoding of a signal (T,) in logged units that removes its jumps; None if there is none.

    Hypotheses are sign-magnitude words and overflowing words, of 2^k steps of the signal's grid or of 2^k revolutions
    (`turn` in logged units, None for joints that do not turn). The best decoding has the fewest remaining jumps, and
    among these the smoothest signal.
    """
    if len(values) < 4:  # the median step might itself be a jump
        return None
    steps = np.diff(values)
    limit = 0.4 * float(np.ptp(values))
    rows = np.flatnonzero(np.abs(steps) > limit)
    # a signal about 0, and with it the sign bit of its words, changes its sign at half of the steps at most
    if not len(rows) or len(rows) > 0.5 * len(values):
        return None
    jump, usual = float(np.median(np.abs(steps[rows]))), _usual(np.abs(steps))
    # torques may reverse abruptly: in a signal with negative values only jumps over the whole range are overflows
    is_signed = values.min() < -FINEST_WORD * np.ptp(values)
    if is_signed and jump < max(0.9 * np.ptp(values), TUNING.jump * usual):
        return None
    sizes = [x for x in _word_sizes(values, turn) if 0.75 < x / jump < 1.35]
    around = np.unique(np.clip(rows[:, None] + np.arange(-2, 3), 0, len(steps) - 1))
    best, best_score = None, (len(rows) / 2, np.inf)
    for size in sizes:
        # overflowing words are within one period but for noise; words with a sign bit are on both sides of it
        readings = []
        if np.ptp(values) < 1.01 * size:
            readings.append(Word("period", size, len(rows), centred(unwrapped(values, size), size)))
        if not is_signed and values.max() >= size:
            readings.append(Word("sign_bit", size, len(rows), signed(values, size)))
        for reading in readings:
            jumps = np.abs(np.diff(reading.values))
            # the steps of a fast motion, or of one across a gap, only become smaller by a period
            if np.median(jumps[rows]) > TUNING.jump * usual:
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
    """Return candidate register sizes of a signal (T,) in logged units: 2^k turns, and 2^k steps of its grid."""
    sizes = [] if turn is None else [turn * 2.0**k for k in range(9)]
    levels = np.unique(values)
    differences = np.diff(levels)
    # values were converted back from SI units: equal ones differ by rounding errors
    differences = differences[differences > FINEST_WORD * np.ptp(values)]
    if differences.size:
        step = float(differences.min())
        numbers = values / step
        if np.abs(numbers - np.round(numbers)).max() < 0.02:
            sizes += [step * 2.0**k for k in range(10, 18)]
    return sizes


def _usual(sizes: np.ndarray) -> float:
    """Return the median of the nonzero step sizes (T,); infinite if all are zero."""
    moving = sizes[sizes > 0]
    return float(np.median(moving)) if moving.size else np.inf
