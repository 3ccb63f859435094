"""The functions of single joints as C: splines as a polynomial for each interval, harmonics by turning a phasor."""

from __future__ import annotations

import numpy as np

from spelgen.exporting.c_tables import Table, table
from spelgen.exporting.description import Splines, TrainedModel
from spelgen.templates import render

_PIECES = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
"""A cubic B-spline's sum on an interval, by powers of s from 0 to 1: of the weights of the four that are not zero."""


def joint_function_source(model: TrainedModel) -> str:
    """The C text of all functions of single joints; empty where there are none."""
    residuals = model.residuals
    torque, factor, ripple = residuals.torque, residuals.friction, residuals.ripple
    if not (residuals.has_torque or factor.joints):
        return ""
    tables: list[Table] = []
    if torque.joints:
        tables += [table("torque_pieces", _rows(torque)), table("torque_energy", _energies(torque))]
    if factor.joints:
        tables.append(table("factor_pieces", _rows(factor)))
    for k, each in enumerate(ripple, start=1):
        tables.append(table(f"ripple_{k}", np.stack([each.cosines, each.sines], axis=1)))
    return render(
        "joint_functions.c.jinja",
        n=model.n,
        intervals=_pieces(factor).shape[1],
        tables=tables,
        torque=_fields(torque),
        factor=_fields(factor),
        ripple=[
            f"{each.joint}, {len(each.cosines)}, {each.frequency!r}, ripple_{k}"
            for k, each in enumerate(ripple, start=1)
        ],
    ).rstrip()


def _pieces(splines: Splines) -> np.ndarray:
    """By spline, interval and power of s, (splines, S + 3, 4); intervals begin two spacings before the first middle."""
    padded = np.pad(splines.weights, ((0, 0), (3, 3)))
    four = np.lib.stride_tricks.sliding_window_view(padded, 4, axis=1)
    found: np.ndarray = four @ _PIECES.T
    return found


def _rows(splines: Splines) -> np.ndarray:
    return _pieces(splines).reshape(-1, 4)


def _energies(splines: Splines) -> np.ndarray:
    """The integral by q up to where each interval begins, (splines (S + 3),), zero in the middle of a single spline."""
    whole = _pieces(splines) @ (1 / np.arange(1, 5)) * splines.spacing[:, None]
    half = 0.5 * splines.weights.sum(axis=1) * splines.spacing
    return (np.cumsum(whole, axis=1) - whole - half[:, None]).ravel()


def _fields(splines: Splines) -> list[str]:
    """joint, start, spacing."""
    start = splines.center - splines.spacing * ((splines.weights.shape[1] - 1) / 2 + 2)
    rows = zip(splines.joints, start, splines.spacing, strict=True)
    return [f"{joint}, {float(first)!r}, {float(spacing)!r}" for joint, first, spacing in rows]
