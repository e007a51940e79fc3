"""Makes mikktspace.npz: tangents by Mikkelsen's own code, for test_accuracy.py.

    git clone https://github.com/mmikk/MikkTSpace        # commit 3e895b4 made the file
    python tests/data/mikktspace.py MikkTSpace

Needs a C compiler. Texture coordinates are handed over with v upward, as the code expects; the
tables keep glTF's v downward. Per case: positions, normals, uvs, faces, and ``corners`` (F, 3, 4),
tangent and sign.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

DRIVER = """
#include "mikktspace.h"
#define C const SMikkTSpaceContext *c
static int F, *I; static float *P, *N, *T, *O;
static int faces(C) { return F; }
static int corners(C, const int f) { return 3; }
static void copy(float *to, const float *from, int n) { for (int k = 0; k < n; k++) to[k] = from[k]; }
static void position(C, float o[], const int f, const int v) { copy(o, P + 3 * I[3 * f + v], 3); }
static void normal(C, float o[], const int f, const int v) { copy(o, N + 3 * I[3 * f + v], 3); }
static void uv(C, float o[], const int f, const int v) { copy(o, T + 2 * I[3 * f + v], 2); }
static void set(C, const float t[], const float s, const int f, const int v) {
    copy(O + 4 * (3 * f + v), t, 3); O[4 * (3 * f + v) + 3] = s;
}
int run(int f, int *i, float *p, float *n, float *t, float *o) {
    F = f; I = i; P = p; N = n; T = t; O = o;
    SMikkTSpaceInterface x = {faces, corners, position, normal, uv, set, 0};
    SMikkTSpaceContext c = {&x, 0};
    return genTangSpaceDefault(&c);
}
"""


def main(source: Path) -> None:
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "driver.c").write_text(DRIVER)
        library = Path(folder) / "driver.so"
        files = [str(Path(folder) / "driver.c"), str(source / "mikktspace.c")]
        subprocess.run(
            ["cc", "-O1", "-shared", "-fPIC", f"-I{source}", "-o", str(library), *files, "-lm"],
            check=True,
        )
        code = ctypes.CDLL(str(library))
        out = {}
        for name, (p, n, t, f) in cases().items():
            corners = np.zeros((len(f), 3, 4), np.float32)
            up = np.ascontiguousarray(np.stack([t[:, 0], 1 - t[:, 1]], 1))
            pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (f, p, n, up, corners)]
            if not code.run(len(f), *pointers):
                raise SystemExit(f"{name}: MikkTSpace refused")
            for key, value in zip(
                ("positions", "normals", "uvs", "faces", "corners"),
                (p, n, t, f, corners),
                strict=True,
            ):
                out[f"{name}/{key}"] = value
    np.savez_compressed(Path(__file__).with_suffix(".npz"), **out)


def cases() -> dict[str, tuple[np.ndarray, ...]]:
    """A bumpy sphere with a seam; a sheet whose UVs are mirrored in the middle; a rough sheet with
    slivers."""
    from appearance_opt.asset.normals import vertex_normals

    rng = np.random.default_rng(4)
    u, v = np.meshgrid(np.linspace(0, 1, 17), np.linspace(0, 1, 13))
    j, i = (a.ravel() for a in np.meshgrid(np.arange(12), np.arange(16), indexing="ij"))
    a = j * 17 + i
    faces = np.concatenate(
        [np.stack([a, a + 17, a + 18], 1), np.stack([a, a + 18, a + 1], 1)]
    ).astype(np.int32)
    polar, azimuth = (0.05 + 0.9 * v) * np.pi, u * 2 * np.pi
    ball = np.stack(
        [np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], -1
    )
    ball *= (1 + 0.1 * np.sin(5 * azimuth) * np.sin(polar) ** 2)[..., None]
    ball[:, -1] = ball[:, 0]
    sheet = np.stack([2 * u - 1, 1 - 2 * v, 0.2 * np.sin(5 * u + 3 * v)], -1)
    rough = sheet + rng.normal(size=sheet.shape) * 0.03
    rough[:, 8] = rough[:, 7] + 1e-3
    plain = np.stack([u, v], -1)
    jitter = plain + rng.normal(size=plain.shape) * 0.01
    mirrored = np.stack([np.abs(2 * u - 1), v], -1)
    out = {}
    for name, p, t in (
        ("ball", ball, jitter),
        ("mirrored", sheet, mirrored),
        ("slivers", rough, jitter),
    ):
        p, t = p.reshape(-1, 3).astype(np.float32), t.reshape(-1, 2).astype(np.float32)
        out[name] = (p, vertex_normals(p, faces), t, faces)
    return out


if __name__ == "__main__":
    main(Path(sys.argv[1]))
