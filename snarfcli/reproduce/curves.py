"""Line charts as SVG: text that any browser draws, without a plotting library."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

__all__ = ["line_chart"]

_LEFT, _TOP, _BOTTOM, _LEGEND = 56, 16, 110, 240
_PLOT_HEIGHT, _STEP = 300, 90
# Okabe and Ito's colours, which people who see fewer colours can tell apart; marks do so in print.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")


def line_chart(names: Sequence[str], series: Mapping[str, Sequence[float | None]], *, y_label: str) -> str:
    """Return an SVG with a line for each of `series` over places called `names`; None leaves a gap.

    Raises:
        ValueError: there is nothing to draw, or a line has another number of values than there are names.
    """
    values = [value for line in series.values() for value in line if value is not None]
    if not values or not names:
        raise ValueError("series: wanted at least one value")
    if any(len(line) != len(names) for line in series.values()):
        raise ValueError(f"series: wanted {len(names)} values in each")
    ticks = _ticks(min(values), max(values))
    plot_width = _STEP * max(1, len(names) - 1)
    width, height = _LEFT + plot_width + 30 + _LEGEND, max(_TOP + _PLOT_HEIGHT + _BOTTOM, _TOP + 20 * len(series))

    def x_of(index: int) -> float:
        return _LEFT + 10 + _STEP * index

    def y_of(value: float) -> float:
        return _TOP + _PLOT_HEIGHT * (1 - (value - ticks[0]) / (ticks[-1] - ticks[0]))

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" font-size="12">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for tick in ticks:
        y = y_of(tick)
        out.append(f'<line x1="{_LEFT}" y1="{y:.1f}" x2="{_LEFT + plot_width + 20}" y2="{y:.1f}" stroke="#dddddd"/>')
        out.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    middle = _TOP + _PLOT_HEIGHT / 2
    out.append(f'<text x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">{escape(y_label)}</text>')
    for index, name in enumerate(names):
        x, y = x_of(index), _TOP + _PLOT_HEIGHT + 14
        out.append(f'<text x="{x}" y="{y}" text-anchor="end" transform="rotate(-35 {x} {y})">{escape(name)}</text>')
    for number, (label, line) in enumerate(series.items()):
        color = _COLORS[number % len(_COLORS)]
        dash = "" if number < len(_COLORS) else ' stroke-dasharray="5 3"'
        points = [(x_of(i), y_of(value)) for i, value in enumerate(line) if value is not None]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        out.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"{dash}/>')
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in points]
        x, y = _LEFT + plot_width + 36, _TOP + 8 + 20 * number
        out.append(f'<line x1="{x}" y1="{y}" x2="{x + 22}" y2="{y}" stroke="{color}" stroke-width="2"{dash}/>')
        out.append(f'<text x="{x + 28}" y="{y + 4}">{escape(label)}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def _ticks(least: float, most: float) -> list[float]:
    """Return four to eight round numbers that enclose two values."""
    span = max(most - least, 1e-6 * max(1.0, abs(most)))
    power = 10.0 ** math.floor(math.log10(span / 4))
    step = next(factor * power for factor in (1, 2, 5, 10) if span / (factor * power) <= 6)
    first, last = math.floor(least / step), math.ceil(most / step)
    last = max(last, first + 1)
    return [round(step * index, 10) for index in range(first, last + 1)]
