"""Charts as inline SVG: coloured by the page's style sheet, so they follow light, dark and print.

All charts have the same margins: where they stand below each other, their times do as well. What a script needs to
tell values from pixels stands in `data-` attributes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

MARGIN_LEFT, MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 62, 14, 10, 36
BARE_BOTTOM = 8  # without labels of x
MAX_POINTS = 300  # per line: more cannot be seen at this size and only makes the file heavy
WIDTH, HEIGHT = 400, 190
MAX_DECADES = 8  # of a logarithmic axis, counted from the largest value


@dataclass(frozen=True, eq=False)
class Line:
    """One curve: x and y of equal length, broken where a value is not finite. `style` is its CSS class."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    style: str


@dataclass(frozen=True, eq=False)
class Band:
    """What lies between two curves over x."""

    label: str
    x: Sequence[float] | np.ndarray
    low: Sequence[float] | np.ndarray
    high: Sequence[float] | np.ndarray
    style: str


@dataclass(frozen=True, eq=False)
class Dots:
    """Points that nothing connects."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    style: str


Mark = Line | Band | Dots


@dataclass(frozen=True)
class Axis:
    """Values low..high shown from pixel `start` to pixel `end`, straight or logarithmic."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def pixel(self, value: float) -> float:
        """Where a value lies; a value below the axis lies on its edge."""
        low, high = self._scale(self.low), self._scale(self.high)
        fraction = (self._scale(max(value, self.low)) - low) / (high - low)
        return self.start + fraction * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Round values within the axis, about five."""
        if self.log:
            first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            decades = [10.0**k for k in range(first, last + 1, max(1, math.ceil((last - first + 1) / 5)))]
            if len(decades) >= 3:
                return decades
            fine = [m * 10.0**k for k in range(first - 1, last + 1) for m in (1, 2, 5)]
            within = [value for value in fine if self.low * (1 - 1e-9) <= value <= self.high * (1 + 1e-9)]
            if len(within) >= 3:
                return within
        step = _round_step((self.high - self.low) / 5)
        return [
            k * step
            for k in range(math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9) + 1)
        ]

    def _scale(self, value: float) -> float:
        return math.log10(value) if self.log else value


def line_chart(
    shown: Sequence[Mark],
    title: str,
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    log_x: bool = False,
    marks: Sequence[tuple[float, str]] = (),
    motion: str = "",
    limits: tuple[float, float] | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Markup:
    """One SVG element with lines, bands and dots, axes, grid and `marks` (vertical lines: x, text).

    log, log_x: logarithmic axes. motion: name of the motion whose time x is, which a script may follow. limits: of y,
    in place of its values'. Without an x_label the x axis has no numbers: those of the chart below are its own. The
    legend is the page's business (`style`, `label`). Without a finite value the chart says so.
    """
    x_values, y_values = _numbers(shown, ("x",)), _numbers(shown, ("y", "low", "high"))
    if limits is not None:
        y_values = np.array(limits)
    x_values, y_values = (
        values[values > 0] if positive else values
        for values, positive in ((x_values, log_x), (y_values, log))
    )
    opening = Markup('<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}"').format(
        width, height, title
    )
    if not x_values.size or not y_values.size:
        empty = Markup('><text x="{}" y="{}" text-anchor="middle">no finite values to show</text></svg>')
        return opening + empty.format(width / 2, height / 2)
    bottom = height - (MARGIN_BOTTOM if x_label else BARE_BOTTOM)
    y_axis = _axis(y_values, bottom, MARGIN_TOP, pad=0.0 if limits else 0.06, log=log)
    x_axis = _axis(x_values, MARGIN_LEFT, width - MARGIN_RIGHT, pad=0.0, log=log_x)
    scales = Markup(' data-x="{}" data-y="{}"').format(_told(x_axis), _told(y_axis))
    moved = Markup(' data-motion="{}"').format(motion) if motion else Markup("")
    parts = [opening, scales, moved, Markup(">"), _frame(x_axis, y_axis, x_label, y_label)]
    parts += [_mark(x, text, x_axis, y_axis) for x, text in marks if x_axis.low <= x <= x_axis.high]
    parts += [_drawn(each, x_axis, y_axis) for each in sorted(shown, key=lambda x: isinstance(x, Line))]
    return Markup("").join([*parts, Markup("</svg>")])


def _numbers(shown: Sequence[Mark], names: Sequence[str]) -> np.ndarray:
    columns = [
        np.asarray(getattr(each, name), dtype=float)
        for each in shown
        for name in names
        if hasattr(each, name)
    ]
    values = np.concatenate(columns or [np.zeros(0)])
    return values[np.isfinite(values)]


def _told(axis: Axis) -> str:
    """For a script: first and last pixel, their values, and whether it is logarithmic."""
    return f"{axis.start:g} {axis.end:g} {axis.low:.6g} {axis.high:.6g} {int(axis.log)}"


def _axis(values: np.ndarray, start: float, end: float, *, pad: float, log: bool = False) -> Axis:
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high * 10.0**-MAX_DECADES)
        low, high = (
            (low / 2, high * 2) if low == high else (low / (high / low) ** pad, high * (high / low) ** pad)
        )
    elif high - low <= 1e-9 * max(abs(low), abs(high)):
        room = 0.5 * abs(high) or 1.0  # a flat line lies in the middle
        low, high = low - room, high + room
    else:
        low, high = low - pad * (high - low), high + pad * (high - low)
    return Axis(low, high, start, end, log)


def _round_step(step: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is not below `step`."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= step * (1 - 1e-9))


def _frame(x_axis: Axis, y_axis: Axis, x_label: str, y_label: str) -> Markup:
    bottom, left = y_axis.start, x_axis.start
    grid, text = (
        Markup('<path class="grid" d="M{:.1f} {:.1f}H{:.1f}"/>'),
        Markup('<text x="{:.1f}" y="{:.1f}" {}>{}</text>'),
    )
    end, middle = Markup('text-anchor="end"'), Markup('text-anchor="middle"')
    parts = []
    for value, label in _labelled(y_axis):
        y = y_axis.pixel(value)
        parts += [grid.format(left, y, x_axis.end), text.format(left - 7, y + 4, end, label)]
    parts.append(Markup('<path class="axis" d="M{:.1f} {:.1f}H{:.1f}"/>').format(left, bottom, x_axis.end))
    if x_label:
        for value, label in _labelled(x_axis):
            parts.append(text.format(x_axis.pixel(value), bottom + 16, middle, label))
        place = Markup('text-anchor="middle" class="label"')
        parts.append(text.format((left + x_axis.end) / 2, bottom + 31, place, x_label))
    y = (bottom + y_axis.end) / 2
    turned = Markup('text-anchor="middle" class="label" transform="rotate(-90 12 {:.1f})"').format(y)
    return Markup("").join([*parts, text.format(12, y, turned, y_label)])


def _labelled(axis: Axis) -> list[tuple[float, str | Markup]]:
    ticks = axis.ticks()
    powers = [math.log10(tick) for tick in ticks] if axis.log else []
    if powers and all(math.isclose(power, round(power), abs_tol=1e-9) for power in powers):
        text = Markup('10<tspan dy="-5" class="power">{}</tspan>')
        return [(tick, text.format(round(power))) for tick, power in zip(ticks, powers, strict=True)]
    if axis.log:
        return [(tick, f"{tick:g}") for tick in ticks]
    decimals = max((_decimals(tick) for tick in ticks), default=0)
    plain = decimals <= 4 and max(map(abs, ticks), default=0.0) < 1e5
    return [(tick, f"{tick:.{decimals}f}" if plain else f"{tick:.2g}") for tick in ticks]


def _decimals(value: float) -> int:
    return len(f"{abs(value):.9f}".rstrip("0").split(".")[1])


def _mark(x: float, text: str, x_axis: Axis, y_axis: Axis) -> Markup:
    pixel, top = x_axis.pixel(x), y_axis.end
    side, anchor = (-5, "end") if pixel > (x_axis.start + x_axis.end) / 2 else (5, "start")
    line = Markup('<path class="mark" d="M{:.1f} {:.1f}V{:.1f}"/>').format(pixel, y_axis.start, top)
    return line + Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(
        pixel + side, top + 10, anchor, text
    )


def _drawn(each: Mark, x_axis: Axis, y_axis: Axis) -> Markup:
    if isinstance(each, Dots):
        return _dots(each, x_axis, y_axis)
    return _band(each, x_axis, y_axis) if isinstance(each, Band) else _path(each, x_axis, y_axis)


def _path(line: Line, x_axis: Axis, y_axis: Axis) -> Markup:
    x, y = np.asarray(line.x, dtype=float), np.asarray(line.y, dtype=float)
    stride = max(1, math.ceil(len(x) / MAX_POINTS))
    steps, at = [], None
    for k in sorted({*range(0, len(x), stride), len(x) - 1} - {-1}):
        if not (math.isfinite(x[k]) and math.isfinite(y[k]) and (y[k] > 0 or not y_axis.log)):
            at = None
            continue
        there = round(10 * x_axis.pixel(x[k])), round(10 * y_axis.pixel(y[k]))  # in tenths of a pixel
        letter, base = ("M", (0, 0)) if at is None else ("l", at)
        steps.append(f"{letter}{(there[0] - base[0]) / 10:g} {(there[1] - base[1]) / 10:g}")
        at = there
    return Markup('<path class="line {}" d="{}"><title>{}</title></path>').format(
        line.style, "".join(steps), line.label
    )


def _band(band: Band, x_axis: Axis, y_axis: Axis) -> Markup:
    """Up to the first value that is not finite; what exceeds the axis ends at its edge."""
    columns = (np.asarray(values, dtype=float) for values in (band.x, band.low, band.high))
    rows = []
    for x, low, high in zip(*columns, strict=True):
        if not (math.isfinite(x) and math.isfinite(low)):
            break
        top = high if math.isfinite(high) else y_axis.high
        rows.append((x_axis.pixel(x), y_axis.pixel(low), y_axis.pixel(min(top, y_axis.high))))
    outline = [(x, low) for x, low, _ in rows] + [(x, high) for x, _, high in reversed(rows)]
    return Markup('<polygon class="band {}" points="{}"><title>{}</title></polygon>').format(
        band.style, " ".join(f"{x:.1f},{y:.1f}" for x, y in outline), band.label
    )


def _dots(dots: Dots, x_axis: Axis, y_axis: Axis) -> Markup:
    """One path of lines without length, whose round ends are the dots."""
    x, y = np.asarray(dots.x, dtype=float), np.asarray(dots.y, dtype=float)
    inside = np.isfinite(x) & np.isfinite(y) & (x >= x_axis.low) & (x <= x_axis.high)
    inside &= (y >= y_axis.low) & (y <= y_axis.high)
    places = zip(x[inside], y[inside], strict=True)
    path = "".join(f"M{x_axis.pixel(a):.1f} {y_axis.pixel(b):.1f}h0" for a, b in places)
    return Markup('<path class="dots {}" d="{}"><title>{}</title></path>').format(
        dots.style, path, dots.label
    )
