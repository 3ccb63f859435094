"""Correlation and spectrum of torque residuals, of recordings and of simulated arms.

    python benchmarks/residual_statistics.py [FOLDER]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings. The arms are identified by least
squares, with friction that has bristle states, from the training recordings of each documented split
(docs/real_logs.md). The residual is the torque error on the same recordings. Fits of the presets, such as `hybrid`, are
not used. `benchmarks/truth.py` prints the same statistics of simulated arms for comparison.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import welch

sys.path.insert(0, str(Path(__file__).parent))

from spelgen.logs.dynamics_samples import FREQUENCY

LAGS = (0.02, 0.1, 0.2, 0.5, 1.0)  # [s] lags of the autocorrelation
# [Hz] edges of frequency bands, up to the cutoff of the torque's filter
BANDS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
SEGMENT = 400  # samples of a periodogram (4 s), so that the band below 0.5 Hz contains two frequencies
HEAD = (
    "residual / torque",
    *(f"r({lag:g} s)" for lag in LAGS),
    *(f"{low:g}-{high:g} Hz" for low, high in pairwise(BANDS)),
)


@dataclass(frozen=True)
class ResidualStatistics:
    """Statistics of a torque residual, means over joints.

    level: standard deviation of the residual divided by the standard deviation of the torque.
    correlation: autocorrelation at `LAGS`. power: share of the residual's power in each of the bands of `BANDS`.
    """

    level: float
    correlation: tuple[float, ...]
    power: tuple[float, ...]

    def columns(self) -> list[float]:
        return [self.level, *self.correlation, *self.power]


def residual_statistics(
    residuals: Sequence[np.ndarray], torques: Sequence[np.ndarray]
) -> ResidualStatistics | None:
    """Return the statistics of torque residuals of trajectories at 100 Hz; None if all are shorter than 4 s.

    Args:
        residuals: (T, n) [Nm, N] of each trajectory.
        torques: (T, n) [Nm, N] of each trajectory.
    """
    pairs = [(x, tau) for x, tau in zip(residuals, torques, strict=True) if len(x) >= SEGMENT]
    if not pairs:
        return None
    residuals = [x - x.mean(axis=0) for x, _ in pairs]
    power = sum(np.square(x).sum(axis=0) for x in residuals)
    torque_power = sum(np.square(tau - tau.mean(axis=0)).sum(axis=0) for _, tau in pairs)
    varies = (power > 0) & (torque_power > 0)

    def correlation(lag: float) -> float:
        k = round(lag * FREQUENCY)
        products = sum((x[k:] * x[:-k]).sum(axis=0) * len(x) / (len(x) - k) for x in residuals)
        return float((products / power)[varies].mean())

    frequency = np.fft.rfftfreq(SEGMENT, 1 / FREQUENCY)
    spectrum = sum(len(x) * welch(x, FREQUENCY, nperseg=SEGMENT, detrend=False, axis=0)[1] for x in residuals)
    cumulative = cumulative_trapezoid(spectrum, frequency, axis=0, initial=0.0)
    # power above 8 Hz, which the filter does not remove completely, is counted in the last band
    edges = [*np.searchsorted(frequency, BANDS[:-1]), len(frequency) - 1]
    shares = np.diff(cumulative[edges], axis=0) / cumulative[-1]
    level = float(np.sqrt(power / torque_power)[varies].mean())
    powers = tuple(float(x) for x in shares[:, varies].mean(axis=1))
    return ResidualStatistics(level, tuple(map(correlation, LAGS)), powers)


def of_recordings(folder: Path) -> dict[str, ResidualStatistics]:
    """Return {split: statistics of the torque residual of least squares with bristle states} on training recordings.

    folder: folder of recordings. The splits are described in docs/real_logs.md; a split whose trajectories are all
    shorter than 4 s is omitted.
    """
    from leaderboard import Problem, by_least_squares, folds

    found = {}
    for fold in folds(folder):
        if "/split" in fold.name:
            problem = Problem(fold, np.inf)
            torque = by_least_squares(memory=True)(problem).torque
            samples = problem.samples_of(problem.logs, pauses=True)
            statistics = residual_statistics([torque(x) - x.tau for x in samples], [x.tau for x in samples])
            if statistics is not None:
                found[fold.name.removesuffix("/split")] = statistics
    return found


def table(rows: dict[str, Sequence[float]]) -> str:
    """Return a table with the head `HEAD` as aligned text. rows: {name of a row: `ResidualStatistics.columns`}."""
    lines = [f"{'':34}" + "".join(f"{x:>{max(9, len(x) + 2)}}" for x in HEAD)]
    for name, columns in rows.items():
        cells = (f"{x:{max(9, len(head) + 2)}.2f}" for x, head in zip(columns, HEAD, strict=True))
        lines.append(f"{name:34}" + "".join(cells))
    return "\n".join(lines)


def main() -> None:
    from recordings import folder_of

    found = of_recordings(folder_of(sys.argv[1] if len(sys.argv) > 1 else None))
    rows: dict[str, Sequence[float]] = {name: x.columns() for name, x in found.items()}
    print(table(rows | {"median": np.median(list(rows.values()), axis=0).tolist()}))


if __name__ == "__main__":
    main()
