"""Constants of pages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RenderTuning:
    """Limits of the charts and the 3D view of a page."""

    # [1] Points of a line: at 400 pixels more are not visible and only make the page larger.
    points: int = 300
    # [1] Decades of a logarithmic axis, counted from the largest value.
    decades: float = 8.0
    # [1] Baselines with an error beyond this multiple of the model's error are cut off, so that the others are
    # distinguishable.
    outlier: float = 100.0
    # [1] Ratio of root mean square to median above which a few starts dominate; a normal distribution has 1.5.
    dominated: float = 2.0
    # [1] Quantile of the measured friction that sets the axis: outliers are cut off.
    bulk: float = 0.995
    # [1] An entry of M below this fraction of the largest entry is a rounding error.
    zero: float = 1e-9
    # [1] Faces of all links together, so that a page stays below 1 MB.
    faces: int = 4000
    # [1] Radius of the tube that represents a link without a mesh, relative to the extent of the arm.
    tube_radius: float = 0.028
    # [1] Relative error that has the last colour of the scale.
    worst_error: float = 0.5


TUNING = RenderTuning()
