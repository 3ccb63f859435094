"""Charts as inline SVG. The page's style sheet sets the colours, for light, dark and print.

All charts have the same margins, so that the time axes of charts in a column are aligned. `data-` attributes of an SVG
element contain the axes, from which a script computes the values at a pixel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.templates import render

Values = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Margins:
    """Margins around the curves [pixels]. bare: bottom margin of a chart whose x axis has no numbers."""

    left: int = 52
    right: int = 14
    top: int = 22
    bottom: int = 36
    bare: int = 8


MARGINS = Margins()


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


TUNING = RenderTuning()


@dataclass(frozen=True)
class Axis:
    """Linear or logarithmic scale: the values low..high lie at the pixels start..end."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def pixels(self, values: np.ndarray) -> np.ndarray:
        """Return the pixels (T,) of values (T,); a value outside the axis lies on its edge."""
        # Clipped first: browsers limit the range of coordinates.
        scale = np.log if self.log else np.asarray
        low, high, clipped = map(scale, (self.low, self.high, np.clip(values, self.low, self.high)))
        pixels: np.ndarray = self.start + (clipped - low) / (high - low) * (self.end - self.start)
        return pixels

    def contains(self, values: np.ndarray) -> np.ndarray:
        """Return a mask (T,): true for the values (T,) within the axis."""
        inside: np.ndarray = (values >= self.low) & (values <= self.high)
        return inside

    def ticks(self) -> list[tuple[float, str]]:
        """Return about five round values within the axis: pixel and label of each."""
        steps = _log_steps if self.log else _steps
        values, labels = steps(self.low, self.high)
        return list(zip(self.pixels(values).tolist(), labels, strict=True))

    def data(self) -> str:
        """Return first and last pixel, their values, and 1 for a logarithmic axis, for a script."""
        return f"{self.start:g} {self.end:g} {self.low:.6g} {self.high:.6g} {int(self.log)}"


@dataclass(frozen=True, eq=False)
class Line:
    """One curve: x and y, (T,), with a gap at values that are not finite. style: its CSS class."""

    label: str
    x: Values
    y: Values
    style: str
    shape = "line"

    @property
    def heights(self) -> np.ndarray:
        """All values of y, (T,), for the range of the axis."""
        return _floats(self.y)

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the SVG path of the segments between gaps, in relative steps of tenths of a pixel."""
        x, y = _floats(self.x), _floats(self.y)
        # evenly spaced samples with the last one included: the line ends at the last value
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
                # Relative steps are short numbers, which make a page smaller.
                segments.append(f"M{_spaced(finite[0])}l{_spaced(np.diff(finite, axis=0))}")
        return "".join(segments)


@dataclass(frozen=True, eq=False)
class Dots(Line):
    """Points without a connecting line."""

    shape = "dots"

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return an SVG path of the points within both axes: lines of length zero, whose round caps are dots."""
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
        """All values of both curves, (2 T,), for the range of the axis."""
        return np.concatenate([_floats(self.low), _floats(self.high)])

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the outline, clipped to the axis; values that are not finite lie on its upper edge."""
        # the upper quantile of a diverged prediction may be infinite while the lower one is finite
        low, high = (np.nan_to_num(_floats(y), nan=np.inf) for y in (self.low, self.high))
        # along the lower curve, then backwards along the upper curve
        x = x_axis.pixels(_floats(self.x))
        columns = np.concatenate([x, x[::-1]])
        rows = y_axis.pixels(np.concatenate([low, high[::-1]]))
        return f"M{_spaced(np.stack([columns, rows], axis=1))}Z"


Mark = Line | Band


@dataclass(frozen=True)
class LegendEntry:
    """A line of a legend: CSS classes of the mark, and its label."""

    style: str
    label: str


@dataclass(frozen=True)
class Chart:
    """An SVG element, and the legend of its visible marks."""

    svg: str
    legend: tuple[LegendEntry, ...]

    def __html__(self) -> str:
        """Return the element, for templates."""
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
    """Return lines, bands and dots over axes and grid; without any finite value, a chart with a note.

    Args:
        marks: Curves in the order of the legend.
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
    bottom = height - (MARGINS.bottom if x_label else MARGINS.bare)
    x_axis = _axis(x_values, MARGINS.left, width - MARGINS.right, pad=0.0, log=log_x)
    # SVG counts pixels downwards: the y axis starts at the bottom
    y_axis = _axis(y_values, bottom, MARGINS.top, pad=0.0 if limits else 0.06, log=log)
    legend, beyond = [], []
    for mark in marks:
        inside = y_axis.contains(_shown([mark.heights], log))
        if inside.any():
            legend.append(LegendEntry(f"{mark.shape} {mark.style}", mark.label))
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
        # lines are drawn above bands and dots, the model's line above the baselines' lines
        marks=sorted(marks, key=lambda mark: (mark.shape == "line", mark.style == "model")),
        beyond=beyond,
    )
    return Chart(svg, tuple(legend))


def _floats(values: Values) -> np.ndarray:
    return np.asarray(values, dtype=float)


def _spaced(pixels: np.ndarray) -> str:
    """Return the numbers of pixels (T, 2) or (2,) rounded to tenths and separated by blanks."""
    return " ".join(f"{round(pixel, 1):g}" for pixel in pixels.ravel().tolist())


def _shown(columns: Sequence[np.ndarray], positive: bool) -> np.ndarray:
    """Return the finite values of all columns (T,), for `positive` the positive ones only, (K,)."""
    values = np.concatenate([np.zeros(0), *columns])
    drawable: np.ndarray = values[np.isfinite(values) & ((values > 0) | (not positive))]
    return drawable


def _axis(values: np.ndarray, start: float, end: float, *, pad: float, log: bool) -> Axis:
    """Return an axis for the values (K,) with margins of `pad` times their range on both sides."""
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high * 10.0**-TUNING.decades)
        # margins of equal width on a logarithmic axis are equal factors
        factor = (high / low) ** pad if high > low else 2.0
        return Axis(low / factor, high * factor, start, end, log=True)
    room = pad * (high - low)
    # otherwise the rounding errors of a constant, about 1e-16, would fill the chart
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        room = 0.5 * abs(high) or 1.0  # a constant line lies in the middle
    return Axis(low - room, high + room, start, end)


def _log_steps(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Return ticks (K,) and labels: powers of ten; for fewer than three, 1, 2 and 5 times these, or `_steps`."""
    # the tolerance keeps a power of ten at the end of the axis in spite of rounding
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
    """Return ticks (K,) and labels: multiples of 1, 2 or 5 times a power of ten."""
    # the smallest step of 1, 2, 5 or 10 times a power of ten that gives at most five intervals
    rough = (high - low) / 5
    fine = 10.0 ** math.floor(math.log10(rough)) * np.array([1, 2, 5, 10])
    # the tolerance keeps a step that equals rough but for rounding
    step = fine[fine >= rough * (1 - 1e-9)][0]
    values = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return values, [f"{value:.6g}" for value in values]
