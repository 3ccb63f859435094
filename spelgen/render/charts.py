"""Charts as inline SVG: coloured by the page's style sheet, so they follow light, dark and print.

All charts have the same margins: where they stand below each other, their times do as well. What a script needs to
tell values from pixels stands in `data-` attributes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spelgen.render.tuning import TUNING
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
        clipped, low, high = np.clip(values, self.low, self.high), self.low, self.high
        if self.log:
            clipped, low, high = np.log(clipped), math.log(low), math.log(high)
        pixels: np.ndarray = self.start + (clipped - low) / (high - low) * (self.end - self.start)
        return pixels

    def contains(self, values: np.ndarray) -> np.ndarray:
        """Return which values lie within the axis."""
        inside: np.ndarray = (values >= self.low) & (values <= self.high)
        return inside

    def ticks(self) -> list[tuple[float, str]]:
        """Return about five round values within the axis, as pixel and label."""
        steps = _log_steps if self.log else _steps
        values, labels = steps(self.low, self.high)
        return list(zip(self.pixels(values).tolist(), labels, strict=True))

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
    def heights(self) -> np.ndarray:
        """Return what the axis of y has to show."""
        return _floats(self.y)

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return pieces of line, in steps of tenths of a pixel from corner to corner."""
        x, y = _floats(self.x), _floats(self.y)
        # samples that are evenly spread, the last one among them: the line ends where the data do
        rows = np.linspace(0, len(x) - 1, min(len(x), TUNING.points)).round().astype(int)
        x, y = x[rows], y[rows]
        gaps = ~(np.isfinite(x) & np.isfinite(y))
        if y_axis.log:
            gaps |= y <= 0
        corners = np.stack([x_axis.pixels(x), y_axis.pixels(y)], axis=1)
        corners[gaps] = np.nan
        pieces = []
        for piece in np.split(np.round(corners, 1), np.flatnonzero(gaps)):
            drawn = piece[np.isfinite(piece[:, 0])]
            if len(drawn) > 1:
                pieces.append(f"M{_spaced(drawn[0])}l{_spaced(np.diff(drawn, axis=0))}")
        return "".join(pieces)


@dataclass(frozen=True, eq=False)
class Dots(Line):
    """Points that nothing connects."""

    kind = "dots"

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return lines without length, whose round ends are the dots; those outside are left out."""
        x, y = _floats(self.x), _floats(self.y)
        inside = x_axis.contains(x) & y_axis.contains(y)
        dots = np.stack([x_axis.pixels(x[inside]), y_axis.pixels(y[inside])], axis=1)
        return "".join(f"M{_spaced(dot)}h0" for dot in dots)


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
    def heights(self) -> np.ndarray:
        """Return what the axis of y has to show."""
        return np.concatenate([_floats(self.low), _floats(self.high)])

    def path(self, x_axis: Axis, y_axis: Axis) -> str:
        """Return the outline; what exceeds the axis ends at its edge, and so does what is not finite."""
        # a prediction that left all bounds has no upper end, but still a lower one
        low, high = (np.nan_to_num(_floats(y), nan=np.inf) for y in (self.low, self.high))
        # along the lower curve, and back along the upper one
        x = x_axis.pixels(_floats(self.x))
        columns = np.concatenate([x, x[::-1]])
        rows = y_axis.pixels(np.concatenate([low, high[::-1]]))
        return f"M{_spaced(np.stack([columns, rows], axis=1))}Z"


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
    x_values = _shown([_floats(mark.x) for mark in marks], log_x)
    y_values = np.array(limits)
    if limits is None:
        y_values = _shown([mark.heights for mark in marks], log)
    if not x_values.size or not y_values.size:
        return Chart(render("chart.html.jinja", **size, x=None), ())
    bottom = height - (MARGINS.bottom if x_label else MARGINS.bare)
    x_axis = _axis(x_values, MARGINS.start, width - MARGINS.end, pad=0.0, log=log_x)
    # SVG counts pixels downwards: the axis of y starts at the bottom
    y_axis = _axis(y_values, bottom, MARGINS.top, pad=0.0 if limits else 0.06, log=log)
    legend, beyond = [], []
    for mark in marks:
        inside = y_axis.contains(_shown([mark.heights], log))
        if inside.any():
            legend.append(Entry(f"{mark.kind} {mark.style}", mark.label))
        if mark.kind == "line" and not inside.all():
            beyond.append(mark.label)
    svg = render(
        "chart.html.jinja",
        **size,
        x=x_axis,
        y=y_axis,
        x_label=x_label,
        y_label=y_label,
        motion=motion,
        # lines are drawn above bands and dots, the model's above those of baselines that it agrees with
        marks=sorted(marks, key=lambda mark: (mark.kind == "line", mark.style == "model")),
        beyond=beyond,
    )
    return Chart(svg, tuple(legend))


def _floats(values: Values) -> np.ndarray:
    return np.asarray(values, dtype=float)


def _spaced(pixels: np.ndarray) -> str:
    """Return numbers in tenths."""
    return " ".join(f"{round(pixel, 1):g}" for pixel in pixels.ravel().tolist())


def _shown(columns: Sequence[np.ndarray], positive: bool) -> np.ndarray:
    """Return all finite values, or those that a logarithmic axis can show."""
    values = np.concatenate([np.zeros(0), *columns])
    drawable = np.isfinite(values)
    if positive:
        drawable &= values > 0
    finite: np.ndarray = values[drawable]
    return finite


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


def _log_steps(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Return powers of ten; 1, 2 and 5 times these, or linear steps, where there are fewer than three."""
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    powers = range(first, last + 1, max(1, (last - first) // 5 + 1))
    if len(powers) >= 3:
        labels = [f"10{str(power).translate(_SUPERSCRIPTS)}" for power in powers]
        return 10.0 ** np.array(powers), labels
    values = np.outer(10.0 ** np.arange(first - 1, last + 1), [1, 2, 5]).ravel()
    values = values[(values >= low) & (values <= high)]
    if len(values) < 3:
        return _steps(low, high)
    return values, [f"{value:.3g}" for value in values]


def _steps(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Return multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / 5
    fine = 10.0 ** math.floor(math.log10(rough)) * np.array([1, 2, 5, 10])
    step = fine[fine >= rough * (1 - 1e-9)][0]  # rounding must not skip a step that just fits
    values = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return values, [f"{value:.6g}" for value in values]
