"""The page of a report: markup, style, and the few lines of script behind its sliders."""

STYLE = """
:root { color-scheme: light dark; --bg: #f6f6f4; --fg: #1d1f21; --soft: #6b6f76; --line: #d9d9d4; --accent: #2f6f8f; }
@media (prefers-color-scheme: dark) {
  :root { --bg: #16181a; --fg: #e8e8e6; --soft: #9aa0a6; --line: #33373b; --accent: #6db5d6; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1080px; padding: 32px 20px 64px; background: var(--bg); color: var(--fg);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 26px; font-weight: 650; letter-spacing: -0.01em; margin: 0 0 20px; }
h2 { font-size: 17px; font-weight: 600; margin: 40px 0 12px; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { text-align: left; padding: 5px 18px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; } .metrics td:not(:first-child), .metrics th { text-align: right; }
.facts td:first-child { color: var(--soft); white-space: nowrap; }
.view { margin: 0 0 28px; display: grid; grid-template-columns: minmax(280px, 5fr) 4fr; gap: 14px; align-items: start; }
@media (max-width: 760px) { .view { grid-template-columns: 1fr; } }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; }
figure { margin: 0; } figcaption { color: var(--soft); font-size: 12.5px; padding-top: 3px; }
img { width: 100%; display: block; border-radius: 6px; }
.slider { position: relative; overflow: hidden; border-radius: 6px; --cut: 50%; }
.slider .after { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--cut)); }
.slider::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--cut); width: 2px; background: #fff;
  box-shadow: 0 0 4px #0008; pointer-events: none; }
.slider input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; }
.slider span { position: absolute; bottom: 8px; padding: 1px 8px; border-radius: 10px; background: #0009; color: #fff;
  font-size: 12px; pointer-events: none; } .slider .l { left: 8px; } .slider .r { right: 8px; }
svg { width: 100%; max-width: 760px; } svg text { font-size: 11px; fill: var(--soft); }
svg .grid { stroke: var(--line); } svg polyline { fill: none; stroke: var(--accent); stroke-width: 2; }
svg circle { fill: var(--accent); }
"""

SLIDER_SCRIPT = """
for (const box of document.querySelectorAll('.slider')) {
  const input = box.querySelector('input');
  input.addEventListener('input', () => box.style.setProperty('--cut', input.value + '%'));
}
"""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{title}}</title><style>{{style}}</style></head><body>
<h1>{{title}}</h1>
{{metrics}}
<h2>Held-out views</h2>
{{views}}
{{maps}}
{{curve}}
<h2>Job</h2>
{{facts}}
{{notes}}
<script>{{script}}</script>
</body></html>
"""
