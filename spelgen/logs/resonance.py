"""Detection of elastic joints, whose apparent inertia at the motor increases with frequency up to a resonance.

For a motor with inertia J_m that drives a link with inertia J_l by a spring, the ratio of the torque in phase with the
acceleration to the acceleration is H(f) = J_m + J_l / (1 - (f / f_0)^2), with the resonance f_0 of the link at a
locked motor. A rigid joint has H = J + c / f^2, with a constant c due to gravity.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from spelgen.logs.joint_signals import JointSignals
from spelgen.logs.rates import shows_accelerations
from spelgen.logs.trajectory import split_at_gaps
from spelgen.logs.tuning import RESONANCE as TUNING


def find_elastic(signals: JointSignals) -> str | None:
    """Find joints whose torques show the resonance of an elastic gear or belt."""
    piece = max(split_at_gaps(signals.trajectory), key=len)
    rate, k = piece.sample_rate, signals.number
    length = round(TUNING.segment * rate)
    if (
        not piece.tau.size
        or not shows_accelerations(rate)
        or len(piece) < TUNING.segments * length
        or not np.ptp(piece.tau[:, k])
    ):
        return None
    frequency, inertia = _apparent_inertia(piece.qd[:, k], piece.tau[:, k], rate, length)
    if len(frequency) < TUNING.fewest_bands:
        return None
    rigid = _relative_error(np.stack([np.ones_like(frequency), frequency**-2.0], axis=1), inertia)[0]
    candidates = []
    for resonance in np.geomspace(frequency[0], TUNING.beyond * frequency[-1], TUNING.candidates):
        # multiplied by the denominator, so that one band at the resonance does not dominate
        factor = 1 - (frequency / resonance) ** 2
        error, (motor, link) = _relative_error(
            np.stack([factor, np.ones_like(factor)], axis=1), factor * inertia
        )
        if motor > 0 and link > TUNING.smallest_link * motor:
            candidates.append((error, resonance, motor, link))
    if not candidates:
        return None
    error, resonance, motor, link = min(candidates)
    if rigid < TUNING.rigid_error or error > min(TUNING.elastic_error, rigid / 2):
        return None
    # up to this frequency the apparent inertia differs from its value at rest by less than `valid`
    share = TUNING.valid * (motor + link) / link
    valid = resonance * float(np.sqrt(share / (1 + share)))
    unit = "kg" if signals.kind == "prismatic" else "kg m^2"
    return (
        f"elastic joint: the inertia that its torque shows, {motor + link:.3g} {unit}, grows with frequency, with a "
        f"resonance at {resonance:.2g} Hz; a model of rigid bodies is valid below {valid:.2g} Hz"
    )


def _apparent_inertia(
    qd: np.ndarray, tau: np.ndarray, rate: float, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (B,) [Hz] and apparent inertias (B,), the in-phase ratios of torque to acceleration, of
    coherent bands.

    Args:
        qd: (T,) velocity [rad/s, m/s].
        tau: (T,) torque [Nm, N].
        rate: sample rate [Hz].
        length: samples of a segment; segments overlap by half.
    """
    frequency = np.fft.rfftfreq(length, 1 / rate)
    kept = (frequency >= TUNING.lowest) & (frequency <= min(TUNING.highest, rate / 3))
    frequency, spectra = frequency[kept], []
    for values in (qd, tau):
        segments = sliding_window_view(values, length)[:: length // 2]
        segments = (segments - segments.mean(axis=1, keepdims=True)) * np.hanning(length)
        spectra.append(np.fft.rfft(segments, axis=1)[:, kept])
    acceleration, torque = spectra[0] * (2j * np.pi * frequency), spectra[1]
    power = np.stack([np.abs(acceleration) ** 2, np.abs(torque) ** 2]).sum(axis=1)
    cross = (acceleration.conj() * torque).sum(axis=0).real
    edges = np.geomspace(TUNING.lowest, frequency[-1], TUNING.bands)
    firsts = np.unique(np.searchsorted(frequency, edges))
    (moved, driven), together = np.add.reduceat(power, firsts, axis=1), np.add.reduceat(cross, firsts)
    means = np.add.reduceat(frequency, firsts) / np.diff(np.append(firsts, len(frequency)))
    # torque in phase with the acceleration, in bands that the motion excites
    coherent = together**2 > TUNING.coherence * moved * driven
    coherent &= moved > TUNING.excited * moved.max(initial=0.0)
    return means[coherent], together[coherent] / moved[coherent]


def _relative_error(columns: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the RMS residual of least squares relative to the RMS of the values (B,), and the coefficients (C,)."""
    x = np.linalg.lstsq(columns, values, rcond=None)[0]
    return float(np.linalg.norm(columns @ x - values) / np.linalg.norm(values)), x
