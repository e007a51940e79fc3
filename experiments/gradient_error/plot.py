"""Table and pictures of what was measured."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import matplotlib

from experiments.gradient_error.summary import summary

IMAGES = Path("docs/images")


def draw(folder: Path) -> None:
    """Markdown tables beside the CSV files in ``folder``, pictures and the CSV files into
    docs/images."""
    matplotlib.use("agg")
    for name in ("vertices", "vertices_l2", "sizes", "sizes_l2"):
        path = folder / f"{name}.csv"
        if not path.exists():
            continue
        with path.open() as file:
            rows = list(csv.DictReader(file))
        path.with_suffix(".md").write_text(table(rows))
        path.with_name(f"{name}_summary.md").write_text(summary(rows))
        error_against_time(rows, IMAGES / f"gradient_error_{name}.png")
        shutil.copyfile(path, IMAGES / f"gradient_error_{name}.csv")


def table(rows: list[dict[str, str]]) -> str:
    """One line per scene and estimator."""
    lines = [
        "| scene, triangles, resolution | estimator | ms | x | fields: error | cosine | bias "
        "| vertices: error | cosine | bias |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        f = {k: float(v) for k, v in r.items() if k not in ("scene", "estimator", "loss")}
        lines.append(
            f"| {r['scene']}, {r['triangles']}, {r['resolution']}² | {r['estimator']} | {f['milliseconds']:.1f} | "
            f"{f['ratio']:.2f} | {f['fields_relative']:.3f} | {f['fields_cosine']:.4f} | "
            f"{100 * f['fields_bias']:+.1f} % | {f['vertices_relative']:.3f} | {f['vertices_cosine']:.3f} | "
            f"{100 * f['vertices_bias']:+.1f} % |"
        )
    return "\n".join(lines) + "\n"


def error_against_time(rows: list[dict[str, str]], path: Path) -> None:
    """One panel per scene: relative error over smooth fields against time, both logarithmic."""
    import matplotlib.pyplot as plt

    cases = list(dict.fromkeys((r["scene"], r["resolution"]) for r in rows))
    columns = min(4, len(cases))
    lines = -(-len(cases) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.4 * columns, 2.9 * lines), squeeze=False, sharey=True
    )
    for axis in axes.ravel()[len(cases) :]:
        axis.axis("off")
    for axis, case in zip(axes.ravel(), cases, strict=False):
        here = [r for r in rows if (r["scene"], r["resolution"]) == case]
        for family, colour, marker in (
            ("none", "#888888", "x"), ("edges", "#c0392b", "o"), ("pairs", "#e08e0b", "s"),
            ("direct_projective", "#2c6fbb", "^"), ("prb_projective", "#5a9e6f", "v"),
        ):  # fmt: skip
            own = [r for r in here if r["estimator"].startswith(family)]
            if not own:
                continue
            x, y = (
                [float(r["milliseconds"]) for r in own],
                [float(r["fields_relative"]) for r in own],
            )
            axis.loglog(x, y, marker=marker, color=colour, label=family, linewidth=1, markersize=5)
        axis.axhline(0.08, color="black", linewidth=0.6, linestyle=":")
        axis.axhline(float(here[0]["reference_fields"]), color="#bbbbbb", linewidth=0.8)
        axis.set_title(f"{case[0]}, {here[0]['triangles']} triangles, {case[1]}²", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25, which="both", linewidth=0.4)
    for axis in axes[:, 0]:
        axis.set_ylabel("relative error over smooth fields", fontsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("ms per gradient", fontsize=7)
    axes[0, 0].legend(fontsize=6)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
