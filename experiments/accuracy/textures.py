"""Texture lookups and mip levels against OpenImageIO's."""

from __future__ import annotations

import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from appearance_opt.render.texture import CLAMP, MIRROR, REPEAT, Pyramid
from appearance_opt.render.texture_upload import Base, build_pyramid

LOOKUPS = 2000
WRAPS = {"clamp": CLAMP, "periodic": REPEAT, "mirror": MIRROR}


def image(size: tuple[int, int], seed: int = 0) -> NDArray[np.float32]:
    """(H, W, 4) noise."""
    return np.random.default_rng(seed).random((size[1], size[0], 4)).astype(np.float32)


def bilinear(size: tuple[int, int], wrap: str) -> float:
    """Largest difference of bilinear lookups at random places, a third of them outside of the unit
    square."""
    import OpenImageIO as oiio

    pixels = image(size)
    uv = np.random.default_rng(1).uniform(-1, 2, (LOOKUPS, 2)).astype(np.float32)
    ours = _lookup(
        build_pyramid([Base.of(pixels)], [WRAPS[wrap]]), uv, np.zeros(LOOKUPS, np.float32)
    )
    buffer = oiio.ImageBuf(pixels)
    theirs = np.array([buffer.interppixel_NDC(float(u), float(v), wrap) for u, v in uv])
    return float(np.abs(ours - theirs).max())


def levels(size: tuple[int, int]) -> list[float]:
    """Largest difference of each mip level from those that OpenImageIO's texture maker writes with
    a box filter."""
    import OpenImageIO as oiio

    pixels = image(size)
    pyramid = build_pyramid([Base.of(pixels)], [CLAMP])
    texels = np.array(pyramid.texels)
    return [
        float(np.abs(theirs - _level(pyramid, texels, k)).max())
        for k, theirs in enumerate(_their_levels(oiio, pixels))
        if theirs.shape[:2] == pyramid.layout.sizes[0][k][::-1]
    ]


def trilinear(size: tuple[int, int]) -> float:
    """Largest difference of trilinear lookups over footprints from a quarter texel to the whole
    texture: theirs is the blend of bilinear lookups in the two nearest of their own levels."""
    import OpenImageIO as oiio

    pixels = image(size)
    rng = np.random.default_rng(2)
    uv = rng.random((LOOKUPS, 2)).astype(np.float32)
    top = np.log2(max(size))
    lod = rng.uniform(-2, top - 0.01, LOOKUPS)
    footprint = (4.0**lod / (size[0] * size[1])).astype(np.float32)
    ours = _lookup(build_pyramid([Base.of(pixels)], [CLAMP]), uv, footprint)
    buffers = [oiio.ImageBuf(np.ascontiguousarray(level)) for level in _their_levels(oiio, pixels)]
    theirs = np.zeros((LOOKUPS, 4))
    for i, ((u, v), at) in enumerate(zip(uv, np.maximum(lod, 0), strict=True)):
        k = int(at)
        fine, coarse = (
            np.array(b.interppixel_NDC(float(u), float(v), "clamp")) for b in buffers[k : k + 2]
        )
        theirs[i] = fine + (at - k) * (coarse - fine)
    return float(np.abs(ours - theirs).max())


def _lookup(pyramid: Pyramid, uv: NDArray, footprint: NDArray) -> NDArray[np.float64]:
    out = pyramid.lookup(None, mi.Point2f(np.ascontiguousarray(uv.T)), mi.Float(footprint))
    return np.stack([np.array(c) for c in out], 1).astype(np.float64)


def _level(pyramid: Pyramid, texels: NDArray, k: int) -> NDArray:
    width, height = pyramid.layout.sizes[0][k]
    start = pyramid.layout.offsets[0][k] * 4
    return texels[start : start + width * height * 4].reshape(height, width, 4)


def _their_levels(oiio: object, pixels: NDArray) -> list[NDArray]:
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "texture.exr")
        spec = oiio.ImageSpec()  # type: ignore[attr-defined]
        spec.attribute("maketx:filtername", "box")
        spec.attribute("compression", "none")
        algo = oiio.ImageBufAlgo  # type: ignore[attr-defined]
        if not algo.make_texture(oiio.MakeTxTexture, oiio.ImageBuf(pixels), path, spec):  # type: ignore[attr-defined]
            raise RuntimeError(oiio.geterror())  # type: ignore[attr-defined]
        file = oiio.ImageInput.open(path)  # type: ignore[attr-defined]
        out = []
        while file.seek_subimage(0, len(out)):
            out.append(np.array(file.read_image(0, len(out), 0, 4, "float")))
        file.close()
    return out
