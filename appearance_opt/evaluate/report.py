"""A folder with pictures, ``report.json`` and one self-contained ``report.html``."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from appearance_opt.asset.images import encode_png
from appearance_opt.errors import one_line
from appearance_opt.evaluate.metrics import Metrics
from appearance_opt.evaluate.template import PAGE, SLIDER_SCRIPT, STYLE
from appearance_opt.publish import publishing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass
class ReportData:
    """Everything a report shows. ``metrics``: by column ("start", "result"); ``views``: per
    held-out view the pictures by name, among them "reference" and "result"; ``maps``: pictures of
    the maps; ``curve``: rows (seconds, step, PSNR, loss); ``facts``: what was asked and done."""

    title: str
    facts: dict[str, Any]
    metrics: dict[str, Metrics]
    views: list[dict[str, NDArray[np.uint8]]]
    maps: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    curve: list[tuple[float, int, float, float]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def write_report(folder: Path, data: ReportData) -> None:
    """Write the report, all of its files or none. Other files in the folder stay."""
    folder = Path(folder)
    encoded: dict[str, bytes] = {}
    for k, view in enumerate(data.views):
        for name, pixels in view.items():
            encoded[f"view{k}_{_slug(name)}.png"] = encode_png(pixels)
    for name, pixels in data.maps.items():
        encoded[f"map_{_slug(name)}.png"] = encode_png(pixels)
    with publishing(folder / "report.html") as place:
        for name, content in encoded.items():
            place.with_name(name).write_bytes(content)
        place.with_name("report.json").write_text(
            json.dumps(as_json(data), indent=1, allow_nan=False)
        )
        place.write_text(page(data, encoded), encoding="utf-8")


_CURVE = ("seconds", "step", "psnr", "loss")


def as_json(data: ReportData) -> dict[str, Any]:
    """The report's numbers."""
    return {
        "title": data.title,
        "facts": data.facts,
        "metrics": {name: asdict(m) for name, m in data.metrics.items()},
        # JSON has no NaN: there is no loss before the first step
        "curve": [
            {
                name: value if math.isfinite(value) else None
                for name, value in zip(_CURVE, row, strict=True)
            }
            for row in data.curve
        ],
        "notes": data.notes,
    }


def page(data: ReportData, encoded: dict[str, bytes]) -> str:
    """The HTML page, pictures inlined."""

    def source(name: str) -> str:
        return "data:image/png;base64," + base64.b64encode(encoded[name]).decode()

    views = "".join(_view_block(k, view, source) for k, view in enumerate(data.views))
    maps = "".join(
        f'<figure><img src="{source(f"map_{_slug(n)}.png")}" alt="{_html(n)}"><figcaption>{_html(n)}'
        "</figcaption></figure>"
        for n in data.maps
    )
    notes = "".join(f"<li>{_html(n)}</li>" for n in data.notes)
    sections = {
        "title": _html(data.title),
        "style": STYLE,
        "script": SLIDER_SCRIPT,
        "metrics": _metrics_table(data.metrics),
        "views": views,
        "maps": f"<h2>Maps</h2><div class='row'>{maps}</div>" if maps else "",
        "curve": f"<h2>Held-out PSNR against time</h2>{curve_svg(data.curve)}"
        if len(data.curve) > 1
        else "",
        "facts": _facts_table(data.facts),
        "notes": f"<h2>Notes</h2><ul>{notes}</ul>" if notes else "",
    }
    # in one pass: a name that looks like a place of the template stays a name
    return re.sub(r"\{\{(\w+)\}\}", lambda place: sections[place[1]], PAGE)


def _html(text: object) -> str:
    """Text of a file or of an option as a page shows it: printable, on one line, without markup."""
    return html.escape(one_line(str(text)))


def curve_svg(
    curve: list[tuple[float, int, float, float]], width: int = 720, height: int = 240
) -> str:
    """Line chart of PSNR (dB) against seconds."""
    xs, ys = [p[0] for p in curve], [p[2] for p in curve]
    low, high = min(ys), max(ys)
    span = max(high - low, 0.1)
    low, high = low - 0.1 * span, high + 0.1 * span
    left, bottom, right, top = 56, 34, 12, 10

    def at(x: float, y: float) -> tuple[float, float]:
        px = left + (width - left - right) * x / max(xs[-1], 1e-9)
        return px, height - bottom - (height - bottom - top) * (y - low) / (high - low)

    points = " ".join(
        f"{a:.1f},{b:.1f}" for a, b in (at(x, y) for x, y in zip(xs, ys, strict=True))
    )
    marks = []
    for k in range(5):
        y = low + (high - low) * k / 4
        _, py = at(0, y)
        marks.append(
            f'<line class="grid" x1="{left}" x2="{width - right}" y1="{py:.1f}" y2="{py:.1f}"/>'
        )
        marks.append(f'<text x="{left - 8}" y="{py + 4:.1f}" text-anchor="end">{y:.2f}</text>')
        x = xs[-1] * k / 4
        px, _ = at(x, low)
        marks.append(f'<text x="{px:.1f}" y="{height - 12}" text-anchor="middle">{x:.0f} s</text>')
    dots = "".join(
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3"/>'
        for a, b in (at(x, y) for x, y in zip(xs, ys, strict=True))
    )
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="PSNR in dB against seconds">'
        f'{"".join(marks)}<polyline points="{points}"/>{dots}</svg>'
    )


def _view_block(index: int, view: dict[str, Any], source: Any) -> str:
    before, after = (source(f"view{index}_{n}.png") for n in ("reference", "result"))
    slider = (
        f'<div class="slider"><img src="{before}" alt="reference"><div class="after"><img src="{after}" alt="result">'
        '</div><input type="range" min="0" max="100" value="50" aria-label="reference or result">'
        '<span class="l">reference</span><span class="r">result</span></div>'
    )
    others = "".join(
        f'<figure><img src="{source(f"view{index}_{_slug(n)}.png")}" alt="{_html(n)}"><figcaption>'
        f"{_html(n)}</figcaption></figure>"
        for n in view
        if n not in ("reference", "result")
    )
    return f"<section class='view'>{slider}<div class='row'>{others}</div></section>"


def _metrics_table(metrics: dict[str, Metrics]) -> str:
    rows = (
        ("PSNR, covered pixels (dB)", "psnr_covered", "{:.2f}"),
        ("PSNR, whole image (dB)", "psnr", "{:.2f}"),
        ("FLIP (lower is better)", "flip", "{:.4f}"),
        ("Silhouette IoU", "silhouette_iou", "{:.4f}"),
        ("Silhouette shift (pixels)", "silhouette_shift", "{:.3f}"),
    )
    head = "".join(f"<th>{_html(n)}</th>" for n in metrics)
    body = "".join(
        f"<tr><td>{label}</td>"
        + "".join(f"<td>{form.format(getattr(m, key))}</td>" for m in metrics.values())
        + "</tr>"
        for label, key, form in rows
    )
    return f"<table class='metrics'><tr><th></th>{head}</tr>{body}</table>"


def _facts_table(facts: dict[str, Any]) -> str:
    rows = "".join(f"<tr><td>{_html(k)}</td><td>{_html(v)}</td></tr>" for k, v in facts.items())
    return f"<table class='facts'>{rows}</table>"


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name.lower())
