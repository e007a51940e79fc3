"""Markdown of what was measured, and its place in the document."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from experiments.speed_vs_error.setups import DEFAULT, GROUPS

if TYPE_CHECKING:
    from experiments.speed_vs_error.results import CurveRow, JobRow


def curve(rows: list[CurveRow], scene: str, lever: str) -> list[CurveRow]:
    """The points of one fit, in the order of time."""
    return sorted(
        (r for r in rows if (r.scene, r.lever) == (scene, lever)), key=lambda r: r.seconds
    )


def scenes_of(rows: list[CurveRow] | list[JobRow]) -> list[str]:
    """In the order in which they were run."""
    return list(dict.fromkeys(r.scene for r in rows))


def levers_of(rows: list[CurveRow]) -> dict[str, list[str]]:
    """Group -> levers that were run, in the order of ``setups.GROUPS``."""
    ran = {r.lever for r in rows}
    groups: dict[str, list[str]] = {}
    for lever, group in GROUPS.items():
        if lever in ran:
            groups.setdefault(group, []).append(lever)
    return groups


def against_default(rows: list[CurveRow], scene: str, lever: str) -> tuple[float, float] | None:
    """(dB above the default, FLIP over that of the default) at the end of both fits, or None
    without them."""
    own, base = curve(rows, scene, lever), curve(rows, scene, DEFAULT)
    if not own or not base:
        return None
    return own[-1].psnr_covered - base[-1].psnr_covered, own[-1].flip / max(base[-1].flip, 1e-9)


def lever_table(rows: list[CurveRow]) -> str:
    """One line per lever, one column per scene: dB and FLIP ratio against the default after the
    same time, and steps."""
    scenes = scenes_of(rows)
    lines = ["| lever | " + " | ".join(scenes) + " |", "|---" * (len(scenes) + 1) + "|"]
    ends = [curve(rows, s, DEFAULT) for s in scenes]
    cells = [
        f"{e[-1].psnr_covered:.2f} dB / {e[-1].flip:.4f} ({e[-1].step} steps)" if e else ""
        for e in ends
    ]
    lines.append("| **default, absolute** | " + " | ".join(cells) + " |")
    starts = [f"{e[0].psnr_covered:.2f} dB / {e[0].flip:.4f}" if e else "" for e in ends]
    lines.append("| *its start* | " + " | ".join(starts) + " |")
    for names in levers_of(rows).values():
        for lever in names:
            if lever != DEFAULT:
                lines.append(
                    f"| {lever} | " + " | ".join(_cell(rows, s, lever) for s in scenes) + " |"
                )
    return "\n".join(lines)


def _cell(rows: list[CurveRow], scene: str, lever: str) -> str:
    found = against_default(rows, scene, lever)
    if found is None:
        return ""
    return f"{found[0]:+.2f} / {found[1]:.2f} ({curve(rows, scene, lever)[-1].step})"


def pareto(rows: list[JobRow], slack: float = 0.02) -> set[str]:
    """Jobs of one scene that none beats: no other is at least as good (within nothing) in no more
    time. ``slack``: part of the time that counts as the same, which is how exactly a budget is
    kept."""
    front = set()
    for r in rows:
        faster = [o for o in rows if o is not r and o.seconds <= (1 + slack) * r.seconds]
        if not any(o.psnr_covered >= r.psnr_covered for o in faster):
            front.add(r.job)
    return front


def job_table(rows: list[JobRow]) -> str:
    """One line per scene and job, the fastest first."""
    lines = [
        "| scene | job | wall time (s) | PSNR, covered (dB) | FLIP | silhouette shift (pixels) | on the front |",
        "|---|---|---|---|---|---|---|",
    ]
    for scene in scenes_of(rows):
        own = sorted((r for r in rows if r.scene == scene), key=lambda r: r.seconds)
        front = pareto(own)
        for r in own:
            name = f"**{r.job}**" if r.job == r.preset else r.job
            lines.append(
                f"| {scene} | {name} | {r.seconds:.1f} | {r.psnr_covered:.2f} | {r.flip:.4f} | "
                f"{r.silhouette_shift:.3f} | {'yes' if r.job in front else 'no'} |"
            )
    return "\n".join(lines)


def insert(document: Path, sections: dict[str, str]) -> None:
    """Put Markdown between ``<!-- NAME -->`` and ``<!-- /NAME -->``. Raises ValueError where a mark
    is missing."""
    text = document.read_text(encoding="utf-8")
    for name, body in sections.items():
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        if begin not in text or end not in text:
            raise ValueError(f"{document}: the marks {begin} and {end} are missing")
        head, rest = text.split(begin, 1)
        text = f"{head}{begin}\n\n{body.strip()}\n\n{end}{rest.split(end, 1)[1]}"
    document.write_text(text, encoding="utf-8")
