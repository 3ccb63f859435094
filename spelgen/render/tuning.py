"""Constants of pages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RenderTuning:
    """Limits of what is drawn on a page."""

    points: int = 300  # of a line: more cannot be seen at 400 pixels and only make the page heavy
    decades: float = 8.0  # of a logarithmic axis, counted from the largest value
    # times the model's error: baselines beyond it are cut off, else all others were flat
    outlier: float = 100.0
    bulk: float = 0.995  # quantile of measured friction that sets the axis: its outliers are cut off
    zero: float = 1e-9  # of the largest entry of M: a smaller one is what rounding leaves of zero
    faces: int = 4000  # of all links together, so that a page stays below 1 MB
    tube_radius: float = 0.028  # of a link without a mesh, relative to the arm's reach
    worst_error: float = 0.5  # relative error that is drawn as the worst colour
    interval: float = 2.0  # standard deviations, a 95 % interval


TUNING = RenderTuning()
