"""Charts as inline SVG: coloured by the page's style sheet, so they follow light, dark and print.

All charts have the same margins: where they stand below each other, their times do as well. What a script needs to
tell values from pixels stands in `data-` attributes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from spelgen.settings.tuning.render import TUNING
from spelgen.templates import render

Values = Sequence[float] | np.ndarray
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Margins:
    """Room around the curves [pixels]. bare: below a chart whose x axis has no numbers."""

    start: int = 52
    end: int = 14
    top: int = 22
    bottom: int = 36
    bare: int = 8


MARGINS = Margins()


@dataclass(frozen=True)
class Axis:
    """Values low..high shown from pixel `start` to pixel `end`, straight or logarithmic."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def pixels(self, values: np.ndarray) -> np.ndarray:
        """Return where values lie; a value outside the axis lies on its edge."""
        clipped = np.clip(values, self.low, self.high)
        if self.log:
            fraction = np.log(clipped / self.low) / math.log(self.high / self.low)
        else:
            fraction = (clipped - self.low) / (self.high - self.low)
        pixels: np.ndarray = self.start + fraction * (self.end - self.start)
        return pixels

    def contains(self, values: np.ndarray) -> np.ndarray:
        """Return which values lie within the axis."""
        inside: np.ndarray = (values >= self.low) & (values <= self.high)
        return inside

    def ticks(self) -> list[tuple[float, str]]:
        """Return about five round values within the axis, as pixel and label."""
        steps = _log_steps if self.log else _steps
        values, labels = steps(self.low, self.high)
        return list(zip(self.pixels(np.array(values)).tolist(), labels, strict=True))

    def data(self) -> str:
        """Return first and last pixel, their values and whether it is logarithmic, for a script."""
        return f"{self.start:g} {self.end:g} {self.low:.6g} {self.high:.6g} {int(self.log)}"


@dataclass(frozen=True, eq=False)
class Line:
    """One curve: x and y of equal length, broken where a value is not finite. `style` is its CSS class."""

    label: str
    x: Values
    y: Values
    style: str
    kind = "line"

    @property
    def heights(self) -> tuple[Values, ...]:
        """Return what the axis of y has to show."""
        return (self.y,)

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return a path in tenths of a pixel, relative steps being shorter."""
        x, y = _floats(self.x), _floats(self.y)
        # every so many samples, and the last one, so that the line ends where the data do
        stride = max(1, math.ceil(len(x) / TUNING.points))
        rows = np.unique([*range(0, len(x), stride), max(len(x) - 1, 0)])[: len(x)]
        drawable = np.isfinite(x[rows]) & np.isfinite(y[rows])
        if y_axis.log:
            drawable &= y[rows] > 0
        gaps = np.flatnonzero(np.diff(np.flatnonzero(drawable)) > 1) + 1
        rows = rows[drawable]
        points = np.stack([x_axis.pixels(x[rows]), y_axis.pixels(y[rows])], axis=1)
        pieces = []
        for piece in np.split(np.round(10 * points), gaps):
            for command, numbers in (("M", piece[:1]), ("l", np.diff(piece, axis=0))):
                if numbers.size:
                    pieces.append(command + " ".join(f"{number / 10:g}" for number in numbers.ravel()))
        return "".join(pieces)


@dataclass(frozen=True, eq=False)
class Dots(Line):
    """Points that nothing connects."""

    kind = "dots"

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return lines without length, whose round ends are the dots; those outside are left out."""
        x, y = _floats(self.x), _floats(self.y)
        inside = x_axis.contains(x) & y_axis.contains(y)
        dots = []
        for column, height in zip(x_axis.pixels(x[inside]), y_axis.pixels(y[inside]), strict=True):
            dots.append(f"M{column:.1f} {height:.1f}h0")
        return "".join(dots)


@dataclass(frozen=True, eq=False)
class Band:
    """The area between two curves over x."""

    label: str
    x: Values
    low: Values
    high: Values
    style: str
    kind = "band"

    @property
    def heights(self) -> tuple[Values, ...]:
        """Return what the axis of y has to show."""
        return self.low, self.high

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the outline up to the first value that is not finite; what exceeds the axis ends at its edge."""
        x, low = _floats(self.x), _floats(self.low)
        # a prediction that left all bounds has no upper end, but still a lower one
        high = np.nan_to_num(_floats(self.high), nan=y_axis.high, posinf=y_axis.high)
        finite = np.isfinite(x) & np.isfinite(low)
        count = len(x) if finite.all() else int(np.argmin(finite))
        columns = x_axis.pixels(x[:count])
        # along the lower curve, and back along the upper one
        columns = np.concatenate([columns, columns[::-1]])
        heights = np.concatenate([y_axis.pixels(low[:count]), y_axis.pixels(high[:count])[::-1]])
        corners = []
        for column, height in zip(columns, heights, strict=True):
            corners.append(f"{column:.1f},{height:.1f}")
        return f"M{' '.join(corners)}Z"


Mark = Line | Band


@dataclass(frozen=True)
class Entry:
    """A line of a legend: CSS classes of the mark, and its label."""

    style: str
    label: str


@dataclass(frozen=True)
class Chart:
    """An SVG element, and the legend of the marks that are visible in it."""

    svg: str
    legend: tuple[Entry, ...]

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
    """Return lines, bands and dots over axes and grid.

    log, log_x: logarithmic axes. motion: name of the motion whose time x is, which a script may follow. limits: of y,
    in place of its values'; the chart names the lines beyond them. Without an x_label the x axis has no numbers: those
    of the chart below are its own. Without a finite value the chart says so.
    """
    size = {"title": title, "width": width, "height": height}
    x_values = _finite([mark.x for mark in marks], log_x)
    y_values = np.array(limits)
    if limits is None:
        y_values = _finite(chain.from_iterable(mark.heights for mark in marks), log)
    if not x_values.size or not y_values.size:
        return Chart(render("chart.html.jinja", **size, x=None), ())
    bottom = height - (MARGINS.bottom if x_label else MARGINS.bare)
    x_axis = _axis(x_values, MARGINS.start, width - MARGINS.end, pad=0.0, log=log_x)
    # SVG counts pixels downwards: the axis of y starts at the bottom
    y_axis = _axis(y_values, bottom, MARGINS.top, pad=0.0 if limits else 0.06, log=log)
    drawn, legend, beyond = [], [], []
    for mark in marks:
        entry = Entry(f"{mark.kind} {mark.style}", mark.label)
        drawn.append((entry, mark.path(x_axis, y_axis)))
        inside = y_axis.contains(_finite(mark.heights, log))
        if inside.any():
            legend.append(entry)
        if mark.kind == "line" and not inside.all():
            beyond.append(mark.label)
    # lines are drawn above bands and dots, the model's above those of baselines that it agrees with
    drawn.sort(key=lambda mark: (mark[0].style.startswith("line"), mark[0].style == "line model"))
    svg = render(
        "chart.html.jinja",
        **size,
        x=x_axis,
        y=y_axis,
        x_label=x_label,
        y_label=y_label,
        motion=motion,
        marks=drawn,
        beyond=beyond,
    )
    return Chart(svg, tuple(legend))


def _floats(values: Values) -> np.ndarray:
    return np.asarray(values, dtype=float)


def _finite(columns: Iterable[Values], positive: bool) -> np.ndarray:
    """Return all finite values, or those that a logarithmic axis can show."""
    values: np.ndarray = np.concatenate([np.zeros(0), *map(_floats, columns)])
    values = values[np.isfinite(values)]
    if positive:
        values = values[values > 0]
    return values


def _axis(values: np.ndarray, start: float, end: float, *, pad: float, log: bool) -> Axis:
    """Return an axis that holds the values, and `pad` of their range on both sides."""
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high * 10.0**-TUNING.decades)
        factor = (high / low) ** pad if high > low else 2.0
        return Axis(low / factor, high * factor, start, end, log=True)
    room = pad * (high - low)
    # rounding alone would otherwise fill the chart with noise of 1e-16
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        room = 0.5 * abs(high) or 1.0  # a flat line lies in the middle
    return Axis(low - room, high + room, start, end)


def _log_steps(low: float, high: float) -> tuple[list[float], list[str]]:
    """Return powers of ten, or 1, 2 and 5 times these where there are fewer than three."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    powers = range(first, last + 1, max(1, (last - first) // 5 + 1))
    if len(powers) >= 3:
        labels = [f"10{str(power).translate(_SUPERSCRIPTS)}" for power in powers]
        return (10.0 ** np.array(powers)).tolist(), labels
    values = np.outer(10.0 ** np.arange(first - 1, last + 1), [1, 2, 5]).ravel()
    values = values[(values >= low) & (values <= high)]
    if len(values) < 3:
        values = np.geomspace(low, high, 4)
    return values.tolist(), [f"{value:.3g}" for value in values]


def _steps(low: float, high: float) -> tuple[list[float], list[str]]:
    """Return multiples of 1, 2 or 5 times a power of ten, with as many decimals as they need."""
    rough = (high - low) / 5
    power = math.floor(math.log10(rough))
    fine = 10.0**power * np.array([1, 2, 5, 10])
    step = float(fine[fine >= rough * (1 - 1e-9)][0])  # rounding must not skip a step that just fits
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values: list[float] = (step * np.arange(first, last + 1)).tolist()
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    if decimals > 4 or max(abs(low), abs(high)) >= 1e5:
        return values, [f"{value:.2g}" for value in values]
    return values, [f"{value:.{decimals}f}" for value in values]
