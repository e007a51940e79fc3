"""Line charts of a report's page, as SVG."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass, field

WIDTH, HEIGHT, LEFT, BOTTOM, RIGHT, TOP = 720, 280, 56, 40, 110, 12

DASHES = ("", "7 4", "2 3", "9 3 2 3", "1 5", "12 4", "4 2", "2 6")
"""Of lines, which differ in more than colour."""

TICKS = 5


@dataclass(frozen=True)
class Chart:
    """``title`` and ``lead``, a sentence; ``x``, ``y``: what the axes show; ``lines``: by name,
    points (x, y), x above 0 on a logarithmic axis; ``bound``: a level to stay below, if there is
    one; ``marks``: places on the x axis by name; ``ticks``: names of places there (none: numbers
    where points are); ``linear``: is the x axis, which then goes from the first x to the last, and
    the y axis as far as the values do?"""

    title: str
    lead: str
    x: str
    y: str
    lines: dict[str, list[tuple[float, float]]]
    bound: float | None = None
    marks: dict[str, float] = field(default_factory=dict)
    ticks: dict[float, str] = field(default_factory=dict)
    linear: bool = False


def chart_svg(chart: Chart) -> str:
    """The chart."""
    points = [p for line in chart.lines.values() for p in line]
    xs = sorted({x for x, _ in points})
    across = float if chart.linear else math.log2
    low, high = across(xs[0]), across(xs[-1])
    ys = [y for _, y in points] + ([] if chart.bound is None else [chart.bound])
    bottom, top = min(0.0, *ys), 1.05 * max(*ys, 1e-9)
    if chart.linear:
        margin = 0.1 * max(max(ys) - min(ys), 0.1)
        bottom, top = min(ys) - margin, max(ys) + margin

    def at(x: float, y: float) -> tuple[float, float]:
        share = (across(x) - low) / max(high - low, 1e-9)
        up = (y - bottom) / (top - bottom)
        return (
            LEFT + (WIDTH - LEFT - RIGHT) * share,
            HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * up,
        )

    out = []
    for k in range(TICKS):
        y = bottom + (top - bottom) * k / (TICKS - 1)
        _, py = at(xs[0], y)
        out.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>'
            f'<text x="{LEFT - 8}" y="{py + 4:.1f}" text-anchor="end">{y:.3g}</text>'
        )
    for x, name in (chart.ticks or {x: f"{x:g}" for x in xs}).items():
        px, py = at(x, bottom)
        name = html.escape(name)
        out.append(f'<text x="{px:.1f}" y="{py + 16:.1f}" text-anchor="middle">{name}</text>')
    if chart.bound is not None:
        _, py = at(xs[0], chart.bound)
        out.append(
            f'<line class="bound" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>'
        )
    for name, x in chart.marks.items():
        px, py = at(min(max(x, xs[0]), xs[-1]), bottom)
        out.append(
            f'<line class="mark" x1="{px:.1f}" x2="{px:.1f}" y1="{TOP}" y2="{py:.1f}">'
            f"<title>{html.escape(name)}</title></line>"
        )
    for k, (name, line) in enumerate(chart.lines.items()):
        placed = [at(x, y) for x, y in sorted(line)]
        drawn = " ".join(f"{a:.1f},{b:.1f}" for a, b in placed)
        dash = f' stroke-dasharray="{DASHES[k % len(DASHES)]}"' if k else ""
        out.append(
            f'<polyline points="{drawn}"{dash}/><text x="{placed[-1][0] + 8:.1f}" '
            f'y="{placed[-1][1] + 4:.1f}">{html.escape(name)}</text>'
        )
    out.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2:.0f}" y="{HEIGHT - 6}" text-anchor="middle">'
        f"{html.escape(chart.x)}</text>"
    )
    label = html.escape(f"{chart.y} against {chart.x}")
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}">{"".join(out)}</svg>'
    )
