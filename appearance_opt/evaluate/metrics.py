"""How different do two sets of images look?"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from appearance_opt.errors import InputError
from appearance_opt.render.display import display

BEST_PSNR = 99.0

NOTICED = 0.1
"""FLIP error from which on an eye notices a pixel that changes: that of colours which differ by
2.3 units in CIELAB, the just noticeable difference of Mahy et al. (1994), by FLIP's own mapping
of distances to errors (Andersson et al. 2020, section 4.1.3: 0.95 (2.3 / 41.3^(1 / 0.7))^0.7 / 0.4
is 0.103), for a viewer 0.7 m from a screen with 67 pixels per degree."""


@dataclass(frozen=True)
class ViewMetrics:
    """One view. PSNR in dB of sRGB display values in [0, 1], over the whole image and over the
    pixels that either image covers; mean FLIP (Andersson et al. 2020, LDR); intersection over union
    of the silhouettes; mean distance in pixels by which they differ (difference in coverage over
    the reference's outline); share of the covered pixels at which a viewer who flips between the
    two notices a difference (see ``NOTICED``)."""

    psnr: float
    psnr_covered: float
    flip: float
    silhouette_iou: float
    silhouette_shift: float
    noticed: float


@dataclass(frozen=True)
class Metrics:
    """Means over views that show anything, and each view."""

    psnr: float
    psnr_covered: float
    flip: float
    silhouette_iou: float
    silhouette_shift: float
    noticed: float
    views: tuple[ViewMetrics, ...]


def compare_images(reference: NDArray, candidate: NDArray) -> Metrics:
    """Metrics of (B, H, W, 4) images, premultiplied linear radiance and coverage. Views in which
    both are empty (the back of a single-sided plane) say nothing, and do not count. Raises
    ValueError for shapes that differ, InputError if no view shows anything."""
    if reference.shape != candidate.shape:
        raise ValueError(f"images differ in shape: {reference.shape} and {candidate.shape}")
    errors = _flip(reference, candidate)
    views = tuple(map(_view, reference, candidate, errors))
    seen = [
        v
        for v, r, c in zip(views, reference, candidate, strict=True)
        if r[..., 3].any() or c[..., 3].any()
    ]
    if not seen:
        raise InputError(
            f"nothing is seen in any of {len(views)} views: there is nothing to compare"
        )
    names = [f.name for f in fields(ViewMetrics)]
    means = {n: float(np.mean([getattr(v, n) for v in seen])) for n in names}
    return Metrics(**means, views=views)


FLIP_PIXELS, FLIP_REACH = 1 << 21, 16
"""Pixels whose FLIP errors are found at once: a call takes time of its own. How far its filters
reach, in pixels: at most ten at 67 pixels per degree."""


def _flip(reference: NDArray, candidate: NDArray) -> NDArray[np.float32]:
    """(B, H, W) FLIP errors. Views are put side by side, each with its own borders repeated as far
    as filters reach, so that none sees another."""
    import flip_evaluator

    count, height, width = reference.shape[:3]
    step = max(1, FLIP_PIXELS // ((width + 2 * FLIP_REACH) * height))
    borders = ((0, 0), (0, 0), (FLIP_REACH, FLIP_REACH), (0, 0))
    out = []
    for start in range(0, count, step):
        wide = []
        for images in (reference, candidate):
            shown = np.pad(display(images[start : start + step]), borders, mode="edge")
            wide.append(np.ascontiguousarray(shown.transpose(1, 0, 2, 3).reshape(height, -1, 3)))
        errors, _, _ = flip_evaluator.evaluate(*wide, "LDR", inputsRGB=True, applyMagma=False)
        split = np.asarray(errors).reshape(height, -1, width + 2 * FLIP_REACH)
        out.append(split[:, :, FLIP_REACH:-FLIP_REACH].transpose(1, 0, 2))
    return np.concatenate(out)


def _view(reference: NDArray, candidate: NDArray, flip: NDArray) -> ViewMetrics:
    a, b = display(reference), display(candidate)
    error = np.mean((a - b) ** 2, axis=-1)
    covered = (reference[..., 3] > 0) | (candidate[..., 3] > 0)
    inside, other = reference[..., 3] > 0.5, candidate[..., 3] > 0.5
    outline = int((inside[1:] != inside[:-1]).sum() + (inside[:, 1:] != inside[:, :-1]).sum())
    return ViewMetrics(
        psnr=_psnr(float(error.mean())),
        psnr_covered=_psnr(float(error[covered].mean()) if covered.any() else 0.0),
        flip=float(flip.mean(dtype=np.float64)),
        silhouette_iou=float((inside & other).sum() / max(int((inside | other).sum()), 1)),
        silhouette_shift=float(
            np.abs(reference[..., 3] - candidate[..., 3]).sum() / max(outline, 1)
        ),
        noticed=float((flip[covered] > NOTICED).mean()) if covered.any() else 0.0,
    )


def _psnr(mean_squared_error: float) -> float:
    if mean_squared_error <= 0:
        return BEST_PSNR
    return float(min(BEST_PSNR, -10 * np.log10(mean_squared_error)))


def halve(images: NDArray) -> NDArray[np.float32]:
    """(B, H, W, 4) images at half the resolution, which must be even: averages of four pixels, as
    the light of a pixel half as fine."""
    b, h, w, c = images.shape
    return images.reshape(b, h // 2, 2, w // 2, 2, c).mean(axis=(2, 4), dtype=np.float32)
