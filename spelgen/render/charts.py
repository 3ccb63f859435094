"""Charts as inline SVG. The style sheet of the page sets the colours for light and dark screens and for print.

All charts have the same margins, so that the time axes of charts in a column are aligned. `data-` attributes of an SVG
element contain its axes, from which a script computes the values at the mouse pointer.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.labels import NamedJoint
from spelgen.templates import render

Values = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class RenderTuning:
    """Margins and limits of the charts, and limits of the 3D view of a page."""

    # [pixels] Margins around the plot area of a chart. `bare` replaces `bottom` if the x axis has no numbers and no
    # label.
    left: int = 52
    right: int = 14
    top: int = 22
    bottom: int = 36
    bare: int = 8
    # [1] Largest number of points of a line: on 400 pixels more points are not visible, and the page becomes larger.
    points: int = 300
    # [1] Largest number of decades of a logarithmic axis. Values that are smaller by more decades are cut off.
    decades: float = 8.0
    # [1] Errors of baselines above this multiple of the model's largest error do not extend the axis of the prediction
    # errors: otherwise one diverged baseline would compress all other lines.
    outlier: float = 100.0
    # [1] If the RMS prediction error exceeds this multiple of the median error, the report states that a few
    # predictions dominate the RMS. A normal distribution has a ratio of 1.5.
    dominated: float = 2.0
    # [1] The axis of the friction chart ends at this quantile of the measured friction, so that outliers do not
    # extend it.
    bulk: float = 0.995
    # [1] An entry of M below this fraction of the largest entry is treated as zero: it is a rounding error.
    zero: float = 1e-9
    # [1] Largest number of faces of all links together, for pages below 1 MB.
    faces: int = 4000
    # [1] Radius of the tube that represents a link without a mesh, relative to the extent of the arm.
    tube_radius: float = 0.028


TUNING = RenderTuning()


@dataclass(frozen=True)
class Axis:
    """Linear or logarithmic axis, which maps the values low..high to the pixels start..end."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def pixels(self, values: np.ndarray) -> np.ndarray:
        """Return the pixels (T,) of values (T,); values outside the axis are clipped to its ends."""
        # Values are clipped, because browsers limit the range of coordinates.
        scale = np.log if self.log else np.asarray
        low, high, clipped = map(scale, (self.low, self.high, np.clip(values, self.low, self.high)))
        return np.asarray(self.start + (clipped - low) / (high - low) * (self.end - self.start))

    def contains(self, values: np.ndarray) -> np.ndarray:
        """Return a mask (T,) of the values (T,) that are within the axis."""
        return (values >= self.low) & (values <= self.high)

    def ticks(self) -> list[tuple[float, str]]:
        """Return the ticks at about five round values within the axis: pixel and label of each tick."""
        steps = _log_steps if self.log else _steps
        values, labels = steps(self.low, self.high)
        return list(zip(self.pixels(values).tolist(), labels, strict=True))

    def data(self) -> str:
        """Return the axis as text for a script: first and last pixel, their values, and 1 if logarithmic."""
        return f"{self.start:g} {self.end:g} {self.low:.6g} {self.high:.6g} {int(self.log)}"


@dataclass(frozen=True, eq=False)
class Line:
    """A curve through the points x, y (T,), interrupted at values that are not finite. style: CSS class."""

    label: str
    x: Values
    y: Values
    style: str
    shape = "line"

    @property
    def heights(self) -> np.ndarray:
        """Values (T,) of the curve, from which the range of the y axis is computed."""
        return _floats(self.y)

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the curve in these axes as an SVG path: its segments between gaps, rounded to tenths of a pixel."""
        x, y = _floats(self.x), _floats(self.y)
        # The drawn samples are evenly spaced and include the last sample, so that the line ends at the last value.
        rows = np.linspace(0, len(x) - 1, min(len(x), TUNING.points)).round().astype(int)
        x, y = x[rows], y[rows]
        gaps = ~(np.isfinite(x) & np.isfinite(y))
        if y_axis.log:
            gaps |= y <= 0
        corners = np.stack([x_axis.pixels(x), y_axis.pixels(y)], axis=1)
        corners[gaps] = np.nan
        segments = []
        for segment in np.split(np.round(corners, 1), np.flatnonzero(gaps)):
            finite = segment[np.isfinite(segment[:, 0])]
            if len(finite) > 1:
                # The path has relative coordinates, because short numbers make the page smaller.
                segments.append(f"M{_spaced(finite[0])}l{_spaced(np.diff(finite, axis=0))}")
        return "".join(segments)


@dataclass(frozen=True, eq=False)
class Dots(Line):
    """Points x, y (T,) without a connecting line."""

    shape = "dots"

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the points within both axes as an SVG path.

        Each point is a line of length zero, whose round caps are visible as a dot.
        """
        x, y = _floats(self.x), _floats(self.y)
        inside = x_axis.contains(x) & y_axis.contains(y)
        dots = np.stack([x_axis.pixels(x[inside]), y_axis.pixels(y[inside])], axis=1)
        return "".join(f"M{_spaced(dot)}h0" for dot in dots)


@dataclass(frozen=True, eq=False)
class Band:
    """The area between two curves low and high over x, (T,) each."""

    label: str
    x: Values
    low: Values
    high: Values
    style: str
    shape = "band"

    @property
    def heights(self) -> np.ndarray:
        """Values of both curves (2 T,), from which the range of the y axis is computed."""
        return np.concatenate([_floats(self.low), _floats(self.high)])

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the outline of the area between two curves as an SVG path, clipped to both axes.

        NaN in a curve, as of diverged predictions, is drawn at the top of the chart.
        """
        # Quantiles of diverged predictions are NaN or infinite: the band of such times extends to the top of the chart.
        low, high = (np.nan_to_num(_floats(y), nan=np.inf) for y in (self.low, self.high))
        # The outline of the band follows the lower curve, then the upper curve backwards.
        x = x_axis.pixels(_floats(self.x))
        columns = np.concatenate([x, x[::-1]])
        rows = y_axis.pixels(np.concatenate([low, high[::-1]]))
        return f"M{_spaced(np.stack([columns, rows], axis=1))}Z"


Mark = Line | Band


@dataclass(frozen=True)
class Chart:
    """A chart: an SVG element, and its legend: CSS classes and label of each visible mark."""

    svg: str
    legend: tuple[tuple[str, str], ...]

    def __html__(self) -> str:
        """Return the SVG element; templates call this method to insert it without escaping."""
        return self.svg


def line_chart(
    marks: Sequence[Mark],
    title: str,
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    log_x: bool = False,
    motion: str = "",
    limits: tuple[float, float] | None = None,
    width: int = 400,
    height: int = 190,
) -> Chart:
    """Return a chart of lines, bands and dots with axes and grid; a chart with a note if no value is finite.

    Args:
        marks: Lines, bands and dots in the order of the legend.
        title: Accessible name of the chart.
        x_label: Label of the x axis; "": no label and no numbers, for a chart above another one with the same axis.
        y_label: Label of the y axis.
        log: Whether the y axis is logarithmic.
        log_x: Whether the x axis is logarithmic.
        motion: Name of the animated motion whose time is x; a script marks the current time.
        limits: Range of the y axis in place of the range of the values; lines beyond it are named in the chart.
        width: Width [pixels].
        height: Height [pixels].
    """
    size = {"title": title, "width": width, "height": height}
    x_values = _shown([_floats(mark.x) for mark in marks], log_x)
    y_values = np.array(limits)
    if limits is None:
        y_values = _shown([mark.heights for mark in marks], log)
    if not x_values.size or not y_values.size:
        return Chart(render("chart.html.jinja", **size, x=None), ())
    bottom = height - (TUNING.bottom if x_label else TUNING.bare)
    x_axis = _axis(x_values, TUNING.left, width - TUNING.right, pad=0.0, log=log_x)
    # SVG counts pixels from the top, so the y axis starts at the larger coordinate `bottom`.
    y_axis = _axis(y_values, bottom, TUNING.top, pad=0.0 if limits else 0.06, log=log)
    legend, beyond = [], []
    for mark in marks:
        inside = y_axis.contains(_shown([mark.heights], log))
        if inside.any():
            legend.append((f"{mark.shape} {mark.style}", mark.label))
        if mark.shape == "line" and not inside.all():
            beyond.append(mark.label)
    svg = render(
        "chart.html.jinja",
        **size,
        x=x_axis,
        y=y_axis,
        x_label=x_label,
        y_label=y_label,
        motion=motion,
        # Later marks cover earlier ones: lines cover bands and dots, and the model's line covers the baselines' lines.
        marks=sorted(marks, key=lambda mark: (mark.shape == "line", mark.style == "model")),
        beyond=beyond,
    )
    return Chart(svg, tuple(legend))


def _floats(values: Values) -> np.ndarray:
    return np.asarray(values, dtype=float)


def _spaced(pixels: np.ndarray) -> str:
    """Return pixel coordinates, (T, 2) or (2,), as text for SVG, "x y x y ...", rounded to 0.1 pixel."""
    return " ".join(f"{round(pixel, 1):g}" for pixel in pixels.ravel().tolist())


def _shown(columns: Sequence[np.ndarray], positive: bool) -> np.ndarray:
    """Return the finite values of all arrays in `columns` as one vector; if `positive`, only the positive values."""
    values = np.concatenate([np.zeros(0), *columns])
    return np.asarray(values[np.isfinite(values) & ((values > 0) | (not positive))])


def _axis(values: np.ndarray, start: float, end: float, *, pad: float, log: bool) -> Axis:
    """Return an axis for values (T,), from `start` to `end` [pixels], with margins of `pad` times the range.

    log: whether the axis is logarithmic.
    """
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high * 10.0**-TUNING.decades)
        # On a logarithmic axis, margins of equal width are equal factors.
        factor = (high / low) ** pad if high > low else 2.0
        return Axis(low / factor, high * factor, start, end, log=True)
    room = pad * (high - low)
    # A nearly constant curve gets a wider axis; otherwise its rounding errors of about 1e-16 would fill the chart.
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        # The margins above and below a constant line are equal, so that it lies in the middle.
        room = 0.5 * abs(high) or 1.0
    return Axis(low - room, high + room, start, end)


def _log_steps(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Return ticks and labels of a logarithmic axis from low to high: powers of ten, if at least three are on it.

    Otherwise the ticks are 1, 2 and 5 times powers of ten. If fewer than three of these values are on the axis, the
    ticks are equidistant, as on a linear axis (`_steps`).
    """
    # With the tolerance 1e-9, a power of ten at the end of the axis is included despite rounding.
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    powers = range(first, last + 1, max(1, (last - first) // 5 + 1))
    if len(powers) >= 3:
        superscripts = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
        return 10.0 ** np.array(powers), [f"10{str(power).translate(superscripts)}" for power in powers]
    values = np.outer(10.0 ** np.arange(first - 1, last + 1), [1, 2, 5]).ravel()
    values = values[(values >= low) & (values <= high)]
    if len(values) < 3:
        return _steps(low, high)
    return values, [f"{value:.3g}" for value in values]


def _steps(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Return ticks and labels of a linear axis from low to high: multiples of 1, 2 or 5 times a power of ten."""
    # The step is the smallest of 1, 2, 5 or 10 times a power of ten that gives at most five intervals.
    rough = (high - low) / 5
    fine = 10.0 ** math.floor(math.log10(rough)) * np.array([1, 2, 5, 10])
    # `rough`: step for exactly five intervals. The tolerance 1e-9 accepts a step that is smaller only by rounding.
    step = fine[fine >= rough * (1 - 1e-9)][0]
    values = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return values, [f"{value:.6g}" for value in values]


@dataclass(frozen=True)
class Panel:
    """A group of charts with a common title, for example the charts of one joint."""

    name: str
    charts: tuple[Chart, ...]


@dataclass(frozen=True, eq=False)
class JointRow:
    """A row of charts, one per joint.

    Attributes:
        title: Title of the charts, without the name of the joint.
        axis: Label of the y axis.
        quantity: "position", "velocity" or "torque", which determines the unit of the y axis; "": no unit is shown.
        columns: Label, values (T, n) and CSS class of each curve. The chart of joint k shows column k of the values.
        height: Height of a chart without the numbers of its time axis [pixels].
    """

    title: str
    axis: str
    quantity: str
    columns: Sequence[tuple[str, np.ndarray, str]]
    height: int = 130


def stacks(
    t: Values, rows: Sequence[JointRow], joints: Sequence[NamedJoint], motion: str = ""
) -> list[Panel]:
    """Return a column of charts per joint; only the last chart has the numbers of the common time axis.

    Args:
        t: Times, (T,) [s].
        rows: The charts of a column, from top to bottom.
        joints: Names and units of the joints.
        motion: Name of the animation of this motion on the page; a script marks its current time in the charts.
    """
    panels = []
    for k, joint in enumerate(joints):
        charts = []
        for row in rows:
            lines = [Line(label, t, values[:, k], style) for label, values, style in row.columns]
            # Only the last chart of a column has a time axis. It is higher, so that all plot areas are equally high.
            time, height = "", row.height
            if row is rows[-1]:
                time, height = "t [s]", row.height + TUNING.bottom - TUNING.bare
            axis = joint.axis(row.quantity, row.axis) if row.quantity else row.axis
            title = f"{row.title} of {joint.name}"
            charts.append(line_chart(lines, title, time, axis, motion=motion, height=height))
        panels.append(Panel(joint.name, tuple(charts)))
    return panels
