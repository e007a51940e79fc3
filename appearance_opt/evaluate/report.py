"""A folder with pictures, ``report.json`` and one self-contained ``report.html``: it can be mailed,
and opens without a network."""

from __future__ import annotations

import base64
import gzip
import html
import json
import math
import re
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from appearance_opt.asset.images import encode_png
from appearance_opt.errors import one_line
from appearance_opt.evaluate import three
from appearance_opt.evaluate.chart import Chart, chart_svg
from appearance_opt.evaluate.environment import panorama
from appearance_opt.evaluate.metrics import Metrics
from appearance_opt.evaluate.pictures import encode_for_page, shrink
from appearance_opt.evaluate.preview import MAX_BYTES, Preview
from appearance_opt.evaluate.sizes import Sizes, in_bytes
from appearance_opt.evaluate.verdict import AtSize, describe_visibility, percent
from appearance_opt.publish import publishing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from appearance_opt.evaluate.motion import Motion

MAP_PIXELS, THUMB_PIXELS = 512, 84
"""Of a page's maps and of the small pictures that choose a view; the folder has maps as they are."""


@dataclass(frozen=True)
class Option:
    """What was asked for: ``flag`` and ``value``, what it means in a sentence, and is it the
    default?"""

    flag: str
    value: Any
    meaning: str
    default: bool


@dataclass
class ReportData:
    """Everything a report shows.

    ``metrics``: by column ("start", "result"); ``columns``: what these are, in a sentence each;
    ``views``: the pictures by name, among them "reference" and "result", perhaps "wireframe", all
    of one view of one size; ``captions``: of the views; ``maps``: pictures of the maps; ``curve``:
    rows (seconds, step, PSNR, loss); ``charts``: more of them; ``facts``: what was asked and done;
    ``by_size``: how different the two look at which size; ``sizes``: of "original" and "result";
    ``previews``: the same in 3D; ``links``: label and file, relative to the folder; ``options``:
    what was asked for; ``azimuth``, ``elevation`` (degrees): from where the viewer looks first;
    ``motion``: of characters.
    """

    title: str
    facts: dict[str, Any]
    metrics: dict[str, Metrics]
    views: list[dict[str, NDArray[np.uint8]]]
    maps: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    curve: list[tuple[float, int, float, float]] = field(default_factory=list)
    charts: list[Chart] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    columns: dict[str, str] = field(default_factory=dict)
    captions: list[str] = field(default_factory=list)
    by_size: list[AtSize] = field(default_factory=list)
    sizes: dict[str, Sizes] = field(default_factory=dict)
    previews: dict[str, Preview] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    options: list[Option] = field(default_factory=list)
    azimuth: float = 35.0
    elevation: float = 18.0
    motion: Motion | None = None


def write_report(folder: Path, data: ReportData) -> None:
    """Write the report, all of its files or none. Other files in the folder stay."""
    folder = Path(folder)
    encoded: dict[str, bytes] = {}
    for k, view in enumerate(data.views):
        for name, pixels in view.items():
            encoded[f"view{k}_{_slug(name)}.png"] = encode_png(pixels)
    for name, pixels in data.maps.items():
        encoded[f"map_{_slug(name)}.png"] = encode_png(pixels)
    if data.motion is not None:
        encoded["film.webp"] = data.motion.film
        for name, pixels in data.motion.stills.items():
            encoded[f"{_slug(name)}.png"] = encode_png(pixels)
    with publishing(folder / "report.html") as place:
        for name, content in encoded.items():
            place.with_name(name).write_bytes(content)
        place.with_name("report.json").write_text(
            json.dumps(as_json(data), indent=1, allow_nan=False)
        )
        place.write_text(page(data), encoding="utf-8")


_CURVE = ("seconds", "step", "psnr", "loss")


def as_json(data: ReportData) -> dict[str, Any]:
    """The report's numbers."""
    return {
        "title": data.title,
        "facts": data.facts,
        "options": {o.flag.lstrip("-"): o.value for o in data.options},
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
        "by_size": [asdict(a) for a in data.by_size],
        "charts": [asdict(c) for c in data.charts],
        "sizes": {name: asdict(a) for name, a in data.sizes.items()},
        **({} if data.motion is None else {"motion": _frames(data.motion)}),
    }


def _frames(motion: Motion) -> dict[str, Any]:
    """Errors by frame."""
    return {"clip": motion.clip, "frames": motion.frames, "psnr": motion.errors}


def page(data: ReportData) -> str:
    """The HTML page with everything in it."""
    sections = {
        "title": _html(data.title),
        "style": _part("style.css"),
        "verdict": _html(verdict(data)),
        "cards": _cards(data.sizes),
        "stage": _stage(data),
        "measured": _measured(data),
        "motion": _motion(data.motion),
        "sizes": _sizes(data.sizes),
        "maps": _maps(data.maps),
        "curve": _section(
            "The fit",
            "PSNR (dB) over whole images of views that the fit does not see, against time.",
            curve_svg(data.curve),
        )
        if len(data.curve) > 1
        else "",
        "charts": "".join(_section(c.title, c.lead, chart_svg(c)) for c in data.charts),
        "facts": _facts(data.facts, data.options),
        "notes": _notes(data.notes),
        "files": _links(data.links),
    }
    sections["viewer"], sections["data"] = _viewer(data)
    scripts = ("stage.js", "viewer.js") if sections["viewer"] else ("stage.js",)
    sections["script"] = "".join(map(_part, scripts))
    # in one pass: a name that looks like a place of the template stays a name
    return re.sub(r"\{\{(\w+)\}\}", lambda place: sections[place[1]], _part("page.html"))


def verdict(data: ReportData) -> str:
    """How much smaller the result is, and whether it looks the same, as measured."""
    said = []
    if {"original", "result"} <= data.sizes.keys():
        a, b = data.sizes["original"], data.sizes["result"]
        shares = [(b.triangles, a.triangles, "triangles"), (b.file_bytes, a.file_bytes, "bytes")]
        said = [
            f"{percent(new / old)} of the {unit}"
            for new, old, unit in shares
            if new is not None and old
        ]
    first = f"{' and '.join(said)}. " if said else ""
    return first + (describe_visibility(data.by_size) if data.by_size else "")


def _part(name: str) -> str:
    return (files("appearance_opt.evaluate") / "page" / name).read_text(encoding="utf-8")


def _html(text: object) -> str:
    """Text of a file or of an option as a page shows it: printable, on one line, without markup."""
    return html.escape(one_line(str(text)))


def _section(title: str, lead: str, content: str) -> str:
    lead = f"<p class='lead'>{lead}</p>" if lead else ""
    return f"<section><h2>{title}</h2>{lead}{content}</section>"


def _image(pixels: NDArray, quality: int | None) -> str:
    """Address of a picture that lies in the page. ``quality``: None for lossless."""
    return "data:image/webp;base64," + base64.b64encode(encode_for_page(pixels, quality)).decode()


def curve_svg(
    curve: list[tuple[float, int, float, float]], width: int = 720, height: int = 240
) -> str:
    """Line chart of PSNR (dB) against seconds."""
    xs, ys = [p[0] for p in curve], [p[2] for p in curve]
    low, high = min(ys), max(ys)
    span = max(high - low, 0.1)
    low, high = low - 0.1 * span, high + 0.1 * span
    left, bottom, right, top = 56, 34, 24, 10

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


def _motion(motion: Motion | None) -> str:
    """The film, what it was made of, and the error by frame."""
    if motion is None:
        return ""
    address = "data:image/webp;base64," + base64.b64encode(motion.film).decode()
    film = (
        f"<figure class='film'><img src='{address}' alt='film of the clip {_html(motion.clip)}: "
        "original, result, difference'><figcaption>original, result, and their difference, four "
        f"times as bright: clip {_html(motion.clip)} at {motion.rate:g} frames per second"
        "</figcaption></figure>"
    )
    told = {"worst frame": "the worst frame", "weights": "weights as colours of the bones"}
    if motion.errors:
        told["worst frame"] += f", {_html(motion.worst[0])}: {motion.worst[1]:.2f} dB"
    stills = "".join(
        f"<figure class='film'><img src='{_image(pixels, 85)}' alt='{_html(name)}' loading='lazy'>"
        f"<figcaption>{told.get(name, _html(name))}</figcaption></figure>"
        for name, pixels in motion.stills.items()
    )
    chart = ""
    if len(motion.frames) > 1:
        count = len(motion.frames)
        shown = sorted({round(k * (count - 1) / 6) for k in range(7)})
        ticks = {float(k): one_line(motion.frames[k]) for k in shown}
        lines = {n: [(float(k), y) for k, y in enumerate(v)] for n, v in motion.errors.items()}
        lead = "PSNR over covered pixels (dB) by frame."
        drawn = Chart("", lead, "frame", "PSNR (dB)", lines, ticks=ticks, linear=True)
        chart = f"<p class='lead'>{lead}</p>{chart_svg(drawn)}"
    return _section("In motion", "", film + chart + stills)


def _cards(sizes: dict[str, Sizes]) -> str:
    if not {"original", "result"} <= sizes.keys():
        return ""
    a, b = sizes["original"], sizes["result"]
    cards = [
        (f"{b.triangles:,}", f"triangles of {a.triangles:,}"),
        (f"{b.draw_calls}", f"draw calls of {a.draw_calls}"),
        (in_bytes(b.texture_bytes), f"texture memory of {in_bytes(a.texture_bytes)}"),
    ]
    if a.file_bytes and b.file_bytes:
        cards.insert(1, (in_bytes(b.file_bytes), f"file of {in_bytes(a.file_bytes)}"))
    items = "".join(f"<li><b>{value}</b><span>{what}</span></li>" for value, what in cards)
    return f"<ul class='cards'>{items}</ul>"


def _choices(name: str, legend: str, choices: dict[str, str]) -> str:
    """A row of buttons of which one is pressed; arrow keys move between them."""
    items = "".join(
        f"<label class='choice'><input type='radio' name='{name}' value='{value}'"
        f"{' checked' if k == 0 else ''}><span>{label}</span></label>"
        for k, (value, label) in enumerate(choices.items())
    )
    return f"<fieldset><legend>{legend}</legend>{items}</fieldset>"


def _stage(data: ReportData) -> str:
    if not data.views:
        return ""
    modes = {"slider": "Slider", "original": "Original", "result": "Result"}
    modes["difference"] = "Difference"
    if any("wireframe" in view for view in data.views):
        modes["wireframe"] = "Wireframe"
    bar = (
        f"<div class='bar'>{_choices('mode', 'What to show', modes)}"
        "<span><button id='farther' type='button' aria-label='zoom out'>&minus;</button> "
        "<button id='whole' type='button' aria-label='whole picture'><span id='zoom'>100 %</span>"
        "</button> <button id='closer' type='button' aria-label='zoom in'>+</button></span>"
        "<label class='range cut'>original | result "
        "<input id='cut' type='range' min='0' max='100' value='50'></label>"
        "<label class='range gain' hidden>brighter "
        "<input id='gain' type='range' min='1' max='16' value='4'></label></div>"
    )
    views = "".join(_view(k, view, data) for k, view in enumerate(data.views))
    thumbs = ""
    if len(data.views) > 1:
        thumbs = "".join(
            f"<button type='button' aria-pressed='{'true' if k == 0 else 'false'}'>"
            f"<img src='{_image(shrink(view['result'], THUMB_PIXELS), 80)}' "
            f"alt='{_html(_caption(data, k))}'></button>"
            for k, view in enumerate(data.views)
        )
        thumbs = f"<div class='thumbs'>{thumbs}</div>"
    return f"<section id='pictures' aria-label='Original and result'>{bar}{views}{thumbs}</section>"


def _caption(data: ReportData, k: int) -> str:
    return data.captions[k] if k < len(data.captions) else f"view {k + 1}"


def _view(k: int, view: dict[str, NDArray], data: ReportData) -> str:
    images = "".join(
        f'<img class="{kind}" src="{_image(view[name], quality)}" alt="{kind}" draggable="false">'
        for kind, name, quality in (
            ("original", "reference", None),
            ("result", "result", None),
            ("wireframe", "wireframe", 85),
        )
        if name in view
    )
    return (
        f"<figure class='view'{' hidden' if k else ''}>"
        "<div class='frame' data-mode='slider' tabindex='0' role='group' aria-label='pictures: "
        "arrow keys move the slider, + and - zoom'>"
        f"<div class='layers'>{images}</div><div class='divider'></div>"
        "<span class='tag left'>original</span><span class='tag right'>result</span></div>"
        f"<figcaption>{_html(_caption(data, k))}</figcaption></figure>"
    )


def _viewer(data: ReportData) -> tuple[str, str]:
    """(the 3D viewer, what it unpacks). Both are empty where there is nothing to show."""
    library = three.library() if "result" in data.previews else None
    if library is None:
        return "", ""
    shown = {n: p for n, p in data.previews.items() if n == "result" or p.size <= MAX_BYTES}
    lead = "Drag to turn, shift-drag to move, wheel or two fingers to zoom; arrow keys work, too. "
    lead += "Textures are compressed for this page."
    original = shown.get("original")
    if original is None and "original" in data.previews:
        lead += " The original is too large for it."
    for name, preview in shown.items():
        if preview.reduced is not None:
            lead += f" The {name} is shown with {preview.reduced:,} triangles."
    show = {"result": "Result", "original": "Original", "both": "Both"}
    looks = {
        "shaded": "Shaded",
        "wireframe": "Wireframe",
        "color": "Base colour",
        "normal": "Normals",
        "roughness": "Roughness",
        "metalness": "Metalness",
        "shape": "Shape",
    }
    bar = (
        f"<div class='bar'>{_choices('show', 'Which asset', show if original else {'result': 'Result'})}"
        f"{_choices('look', 'What it wears', looks)}"
        f"{_choices('light', 'Light', {'environment': 'Environment', 'lamp': 'Lamp'})}"
        "<button id='upright' type='button'>Reset view</button>"
        "<label class='range divide' hidden>original | result "
        "<input id='divide' type='range' min='0' max='100' value='50'></label></div>"
    )
    viewer = (
        f"<section id='viewer'><h2>In 3D</h2><p class='lead'>{lead}</p>{bar}"
        "<div class='canvas' data-show='result'><p class='message'>The 3D view needs scripts and "
        "WebGL.</p><div class='divider'></div><span class='tag left'>original</span>"
        "<span class='tag right'>result</span></div></section>"
    )
    sky = {
        **_sky(),
        "azimuth": math.radians(data.azimuth),
        "elevation": math.radians(data.elevation),
    }
    packed = [
        f"<script type='text/plain' id='three-js'>{_packed(library.encode())}</script>",
        f"<script type='application/json' id='sky'>{_json(sky)}</script>",
    ]
    for name, preview in shown.items():
        scene = {
            "header": preview.header,
            "data": _packed(preview.data),
            "images": [base64.b64encode(i).decode() for i in preview.images],
        }
        packed.append(
            f"<script type='application/json' class='scene' data-name='{name}'>{_json(scene)}"
            "</script>"
        )
    return viewer, "\n".join(packed)


def _sky(height: int = 64) -> dict[str, Any]:
    """The environment as three.js takes panoramas: the middle column shows +X, the last row what is
    above; half precision."""
    turned = np.roll(panorama(height), -height // 2, axis=1)[::-1]
    pixels = np.concatenate([turned, np.ones_like(turned[..., :1])], axis=-1).astype(np.float16)
    return {"width": 2 * height, "height": height, "data": _packed(pixels.tobytes())}


def _packed(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()


def _json(value: object) -> str:
    """JSON that may stand in a script element: nothing in it ends one."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _measured(data: ReportData) -> str:
    if not data.metrics:
        return ""
    bars = ""
    if data.by_size:
        rows = "".join(
            f"<span>{a.pixels} pixels</span><div><i style='width:{100 * a.noticed:.2f}%'></i></div>"
            f"<span>{percent(a.noticed)}</span>"
            for a in reversed(data.by_size)
        )
        bars = (
            "<p>Share of the pixels where an eye notices a difference when it flips between "
            "original and result (a FLIP error above 0.1, one just noticeable difference, on a "
            f"screen 0.7 m away), by the size of the picture:</p><div class='shares'>{rows}</div>"
        )
    told = "".join(f"<li><b>{_html(n)}</b>: {_html(text)}</li>" for n, text in data.columns.items())
    told = f"<ul class='lead'>{told}</ul>" if told else ""
    views = len(next(iter(data.metrics.values())).views)
    lead = f"Means over {views} random views, each under a lamp of its own; nothing was chosen by them."
    return _section("How alike they look", lead, bars + _metrics_table(data.metrics) + told)


def _metrics_table(metrics: dict[str, Metrics]) -> str:
    rows = (
        ("PSNR, covered pixels (dB)", "psnr_covered", "{:.2f}"),
        ("PSNR, whole image (dB)", "psnr", "{:.2f}"),
        ("FLIP (lower is better)", "flip", "{:.4f}"),
        ("Pixels where a difference is noticed", "noticed", "{:.1%}"),
        ("Silhouette IoU", "silhouette_iou", "{:.4f}"),
        ("Silhouette shift (pixels)", "silhouette_shift", "{:.3f}"),
    )
    head = "".join(f"<th scope='col'>{_html(n)}</th>" for n in metrics)
    body = "".join(
        f"<tr><th scope='row'>{label}</th>"
        + "".join(f"<td>{form.format(getattr(m, key))}</td>" for m in metrics.values())
        + "</tr>"
        for label, key, form in rows
    )
    return (
        f"<div class='scroll'><table class='numbers'><tr><td></td>{head}</tr>{body}</table></div>"
    )


def _sizes(sizes: dict[str, Sizes]) -> str:
    if not sizes:
        return ""
    counts = (
        ("Triangles", lambda s: f"{s.triangles:,}"),
        ("Vertices", lambda s: f"{s.vertices:,}"),
        ("Draw calls (meshes)", lambda s: f"{s.draw_calls:,}"),
        ("Materials", lambda s: f"{s.materials:,}"),
        ("Textures", lambda s: _textures(s)),
        ("Texture memory, with mip levels", lambda s: in_bytes(s.texture_bytes)),
        ("Files", lambda s: in_bytes(s.file_bytes) if s.file_bytes else "not on disk"),
    )
    head = "".join(f"<th scope='col'>{_html(n)}</th>" for n in sizes)
    body = "".join(
        f"<tr><th scope='row'>{label}</th>"
        + "".join(f"<td>{show(s)}</td>" for s in sizes.values())
        + "</tr>"
        for label, show in counts
    )
    table = f"<table class='numbers'><tr><td></td>{head}</tr>{body}</table>"
    return _section("Sizes", "", f"<div class='scroll'>{table}</div>")


def _textures(s: Sizes) -> str:
    """How many of which size: "3 of 1024 x 1024"."""
    counts: dict[tuple[int, int], int] = {}
    for m in s.maps:
        counts[m.width, m.height] = counts.get((m.width, m.height), 0) + 1
    largest = sorted(counts.items(), key=lambda item: -item[0][0] * item[0][1])
    told = [f"{n} of {w} &times; {h}" for (w, h), n in largest[:3]]
    rest = sum(n for _, n in largest[3:])
    return ", ".join([*told, *([f"{rest} smaller"] if rest else [])]) or "none"


def _maps(maps: dict[str, NDArray]) -> str:
    figures = "".join(
        f'<figure><a href="map_{_slug(n)}.png"><img src="{_image(shrink(pixels, MAP_PIXELS), 80)}" '
        f'alt="{_html(n)}" loading="lazy"></a><figcaption>{_html(n)}, {pixels.shape[1]} &times; '
        f"{pixels.shape[0]}</figcaption></figure>"
        for n, pixels in maps.items()
    )
    lead = "As they are stored; each leads to its PNG in the report's folder."
    return _section("Maps", lead, f"<div class='row'>{figures}</div>") if maps else ""


def _notes(notes: list[str]) -> str:
    items = "".join(f"<li>{_html(n)}</li>" for n in notes)
    return (
        _section("Notes", "What was dropped, repaired or assumed.", f"<ul>{items}</ul>")
        if notes
        else ""
    )


def _facts(facts: dict[str, Any], options: list[Option]) -> str:
    rows = "".join(f"<tr><td>{_html(k)}</td><td>{_html(v)}</td></tr>" for k, v in facts.items())
    done = asked = ""
    if rows:
        done = (
            "<details><summary>What was done</summary>"
            f"<div class='scroll'><table class='facts'>{rows}</table></div></details>"
        )
    chosen = sorted(options, key=lambda o: o.default)
    rows = "".join(
        f"<tr><td><code>{_html(o.flag)}</code></td><td>{_html(o.value)}"
        f"{'' if o.default else ' <b>(chosen)</b>'}</td><td>{_html(o.meaning)}</td></tr>"
        for o in chosen
    )
    if rows:
        asked = (
            "<details><summary>What was asked for</summary>"
            f"<div class='scroll'><table class='facts'>{rows}</table></div></details>"
        )
    return done + asked


def _links(links: dict[str, str]) -> str:
    items = "".join(
        f'<li><a href="{html.escape(quote(target), quote=True)}">{_html(label)}</a></li>'
        for label, target in links.items()
    )
    return _section("Files", "", f"<ul>{items}</ul>") if items else ""


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name.lower())
