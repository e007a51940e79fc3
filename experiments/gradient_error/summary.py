"""The table's answers in one line per scene."""

from __future__ import annotations

PEER = "direct_projective, 64 spp"
ERROR, BIAS = 0.08, 0.03
"""What a gradient is allowed over smooth fields: relative error and bias. More of either slows a
fit down visibly (docs/accuracy.md)."""

Row = dict[str, str]


def summary(rows: list[Row]) -> str:
    """Of each scene: the cheapest of our settings within ``ERROR`` and ``BIAS``, and the cheapest
    that is no worse than ``PEER`` over fields and over single vertices, where the peer was
    measured."""
    lines = [
        "| scene, triangles, resolution | cheapest within 0.08 and 3 % | x | error, bias "
        "| direct_projective, 64 spp: ms | its errors | cheapest of ours no worse | ms | its errors | ratio |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for case in dict.fromkeys((r["scene"], r["triangles"], r["resolution"]) for r in rows):
        here = [r for r in rows if (r["scene"], r["triangles"], r["resolution"]) == case]
        ours = sorted((r for r in here if "projective" not in r["estimator"]), key=milliseconds)
        peer = next((r for r in here if r["estimator"] == PEER), None)
        good = next(
            (r for r in ours if errors(r)[0] <= ERROR and abs(float(r["fields_bias"])) <= BIAS),
            None,
        )
        cells = [f"{case[0]}, {case[1]}, {case[2]}²", *within(good)]
        lines.append("| " + " | ".join(cells + (against(peer, ours) if peer else [""] * 6)) + " |")
    return "\n".join(lines) + "\n"


def within(good: Row | None) -> list[str]:
    """Cells of the setting that keeps the bounds."""
    if good is None:
        return ["none", "", ""]
    bias = 100 * float(good["fields_bias"])
    return [
        good["estimator"],
        f"{float(good['ratio']):.1f}",
        f"{errors(good)[0]:.3f}, {bias:+.1f} %",
    ]


def against(peer: Row, ours: list[Row]) -> list[str]:
    """Cells of the peer and of the setting that is no worse."""
    no_worse = next(
        (r for r in ours if all(a <= b for a, b in zip(errors(r), errors(peer), strict=True))), None
    )
    cells = [f"{milliseconds(peer):.0f}", pair(peer)]
    if no_worse is None:
        return [*cells, "none", "", "", ""]
    ratio = milliseconds(peer) / milliseconds(no_worse)
    return [
        *cells,
        no_worse["estimator"],
        f"{milliseconds(no_worse):.1f}",
        pair(no_worse),
        f"{ratio:.0f}",
    ]


def milliseconds(row: Row) -> float:
    return float(row["milliseconds"])


def errors(row: Row) -> tuple[float, float]:
    """Relative error over smooth fields and over single vertices, as they are shown."""
    return round(float(row["fields_relative"]), 3), round(float(row["vertices_relative"]), 3)


def pair(row: Row) -> str:
    return " / ".join(f"{e:.3f}" for e in errors(row))
