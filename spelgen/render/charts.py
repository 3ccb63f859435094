"""Line charts as inline SVG: coloured by the page's style sheet, so they follow light, dark and print."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 18, 10, 36
LABEL_ROOM, DIGIT = 28, 7  # left of the y axis: its label, and each character of its ticks
MAX_POINTS = 600  # per line: more cannot be seen at this size and only makes the file heavy
MAX_DECADES = 8  # of a logarithmic axis, counted from the largest value


@dataclass(frozen=True, eq=False)
class Line:
    """One curve: x and y of equal length, broken where a value is not finite. `style` is its CSS class."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    style: str


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
    lines: Sequence[Line],
    title: str,
    x_label: str,
    y_label: str,
    *,
    log: bool = False,
    marks: Sequence[tuple[float, str]] = (),
    width: int = 640,
    height: int = 260,
) -> Markup:
    """One SVG element with the lines, axes, grid and `marks` (vertical lines: x, text); `log` is the y axis.

    The legend is the page's business (`Line.style`, `Line.label`). Without a finite value the chart says so.
    """
    x_values, y_values = _finite(lines, "x"), _finite(lines, "y")
    if log:
        y_values = y_values[y_values > 0]
    opening = Markup('<svg class="chart" viewBox="0 0 {} {}" role="img" aria-label="{}">').format(
        width, height, title
    )
    if not x_values.size or not y_values.size:
        empty = Markup('<text x="{}" y="{}" text-anchor="middle">no finite values to show</text></svg>')
        return opening + empty.format(width / 2, height / 2)
    y_axis = _axis(y_values, height - MARGIN_BOTTOM, MARGIN_TOP, pad=0.06, log=log)
    longest = max(len(Markup(label).striptags()) for _, label in _labelled(y_axis))
    x_axis = _axis(x_values, LABEL_ROOM + DIGIT * longest, width - MARGIN_RIGHT, pad=0.0)
    parts = [opening, _frame(x_axis, y_axis, x_label, y_label)]
    parts += [_mark(x, text, x_axis, y_axis) for x, text in marks if x_axis.low <= x <= x_axis.high]
    parts += [_path(line, x_axis, y_axis) for line in lines]
    return Markup("").join([*parts, Markup("</svg>")])


def _finite(lines: Sequence[Line], name: str) -> np.ndarray:
    values = np.concatenate([np.asarray(getattr(line, name), dtype=float) for line in lines] or [np.zeros(0)])
    return values[np.isfinite(values)]


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
    for value, label in _labelled(x_axis):
        parts.append(text.format(x_axis.pixel(value), bottom + 16, middle, label))
    parts.append(Markup('<path class="axis" d="M{:.1f} {:.1f}H{:.1f}"/>').format(left, bottom, x_axis.end))
    parts.append(
        text.format(
            (left + x_axis.end) / 2, bottom + 31, Markup('text-anchor="middle" class="label"'), x_label
        )
    )
    y = (bottom + y_axis.end) / 2
    turned = Markup('text-anchor="middle" class="label" transform="rotate(-90 12 {:.1f})"').format(y)
    return Markup("").join([*parts, text.format(12, y, turned, y_label)])


def _labelled(axis: Axis) -> list[tuple[float, str | Markup]]:
    ticks = axis.ticks()
    powers = [math.log10(tick) for tick in ticks] if axis.log else []
    if powers and all(math.isclose(power, round(power), abs_tol=1e-9) for power in powers):
        text = Markup('10<tspan dy="-5" class="power">{}</tspan>')
        return [(tick, text.format(round(power))) for tick, power in zip(ticks, powers, strict=True)]
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


def _path(line: Line, x_axis: Axis, y_axis: Axis) -> Markup:
    x, y = np.asarray(line.x, dtype=float), np.asarray(line.y, dtype=float)
    stride = max(1, math.ceil(len(x) / MAX_POINTS))
    steps, down = [], False
    for k in sorted({*range(0, len(x), stride), len(x) - 1} - {-1}):
        drawn = math.isfinite(x[k]) and math.isfinite(y[k]) and (y[k] > 0 or not y_axis.log)
        if drawn:
            steps.append(f"{'L' if down else 'M'}{x_axis.pixel(x[k]):.1f} {y_axis.pixel(y[k]):.1f}")
        down = drawn
    return Markup('<path class="line {}" d="{}"><title>{}</title></path>').format(
        line.style, "".join(steps), line.label
    )
