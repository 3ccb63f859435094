"""Make trajectories of rows in SI units: holes left out, velocities differentiated, late torques moved."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from spelgen.logs.tables import Layout
from spelgen.logs.trajectory import Trajectory, gap_ends
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def make_trajectory(
    data: np.ndarray, layout: Layout, name: str, file: Path, repairs: tuple[str, ...] = ()
) -> Trajectory:
    """Return a trajectory of these rows (T, C) in SI units, velocities differentiated where there are none."""
    quantities = layout.mapping.quantities
    if layout.mapping.dropouts == "dropped":
        holes = np.any([is_dropout(column) for column in data[:, 1:].T], axis=0)
        if holes.any():
            data = data[~holes]
            repairs += (f"{holes.sum()} rows in which a signal fell to 0 were left out",)
    t = data[:, 0]
    signals = dict(zip(quantities, np.split(data[:, 1:], len(quantities), axis=1), strict=True))
    q = signals["q"]
    qd = signals["qd"] if "qd" in signals else _differentiated(t, q)
    tau = np.zeros((len(t), 0))
    if "tau" in signals:
        tau = earlier(t, signals["tau"], layout.mapping.torque_delay)
    return Trajectory(t, q, qd, tau, name, file, layout.accepted, signals.get("u"), repairs)


def is_dropout(values: np.ndarray) -> np.ndarray:
    """Whether each sample (T,) is exactly 0 between samples that are far from 0: what loggers write for no value."""
    dropout = np.zeros(len(values), bool)
    edges = np.diff((values == 0).astype(int))
    starts, stops = np.flatnonzero(edges > 0) + 1, np.flatnonzero(edges < 0) + 1
    if not starts.size:
        return dropout
    steps = np.abs(np.diff(values[values != 0]))
    usual = np.median(steps[steps > 0]) if steps.any() else np.inf
    stops = stops[stops > starts[0]]
    starts = starts[: len(stops)]  # zeros at the end have nothing behind them
    # a signal that passes through 0 comes near it first
    nearest = np.minimum(np.abs(values[starts - 1]), np.abs(values[stops]))
    far = nearest > TUNING.dropout * usual
    for start, stop in zip(starts[far].tolist(), stops[far].tolist(), strict=True):
        dropout[start:stop] = True
    return dropout


def _differentiated(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return central differences (T, n) within each gap-free piece; 0 for a lone sample, of which no window is cut."""
    qd = np.zeros_like(q)
    for start, stop in pairwise(gap_ends(t)):
        if stop - start > 1:
            qd[start:stop] = np.gradient(q[start:stop], t[start:stop], axis=0)
    return qd


def earlier(t: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """Return what is logged so much later [s], (T, n), held at the ends of each gap-free piece."""
    if not delay:
        return values
    from scipy.interpolate import CubicSpline  # takes long to import, as in `low_pass`

    moved = values.copy()
    for start, stop in pairwise(gap_ends(t)):
        if stop - start > 1:
            times = t[start:stop]
            # a line from sample to sample would damp torques at times between samples, and noise with them
            at = CubicSpline(times, values[start:stop])
            moved[start:stop] = at(np.clip(times + delay, times[0], times[-1]))
    return moved
