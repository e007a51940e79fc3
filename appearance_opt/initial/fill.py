"""Texels that nothing is known of, filled from coarser levels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt


def fill(values: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Pull and push (Gortler et al. 1996): unknown texels of (H, W, C) take the average of the
    nearest known ones, smoothly. Known texels stay as they are; with none known, all stay."""
    if known.all() or not known.any():
        return values
    levels = [(values * known[..., None], known.astype(np.float32))]
    while min(levels[-1][1].shape) > 1:
        levels.append(_half(*levels[-1]))
    coarse, weight = levels[-1]
    current = coarse / np.maximum(weight, 1e-12)[..., None]
    for total, weight in reversed(levels[:-1]):
        up = _double(current, weight.shape)
        have = np.minimum(weight, 1.0)[..., None]
        current = total / np.maximum(weight, 1e-12)[..., None] * have + up * (1 - have)
    return np.where(known[..., None], values, current).astype(np.float32)


def nearest_charts(covered: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(rows, columns) (H, W) of the texel in a chart that is nearest to each texel: texels between
    charts that have its colour keep those of other charts out of coarse mip levels, where a texel
    stands for many (docs/trials.md: texels). ``covered``: those in charts, at least one."""
    rows, columns = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return rows, columns


def _half(total: NDArray, weight: NDArray) -> tuple[NDArray, NDArray]:
    """Sums over 2 x 2 texels, with the weight cut at 1 so that a few known texels count in full."""
    h, w = (s + s % 2 for s in weight.shape)
    if (h, w) != weight.shape:
        total = np.pad(total, ((0, h - total.shape[0]), (0, w - total.shape[1]), (0, 0)))
        weight = np.pad(weight, ((0, h - weight.shape[0]), (0, w - weight.shape[1])))
    total = total[0::2, 0::2] + total[0::2, 1::2] + total[1::2, 0::2] + total[1::2, 1::2]
    weight = weight[0::2, 0::2] + weight[0::2, 1::2] + weight[1::2, 0::2] + weight[1::2, 1::2]
    scale = np.minimum(1.0, 1.0 / np.maximum(weight, 1e-12))
    return total * scale[..., None], weight * scale


def _double(x: NDArray, shape: tuple[int, ...]) -> NDArray:
    """Bilinear enlargement by two, cut to ``shape``."""
    for axis in (0, 1):
        before = np.concatenate([x.take([0], axis), x.take(range(x.shape[axis] - 1), axis)], axis)
        after = np.concatenate([x.take(range(1, x.shape[axis]), axis), x.take([-1], axis)], axis)
        even, odd = 0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after
        x = np.stack([even, odd], axis + 1).reshape(*x.shape[:axis], -1, *x.shape[axis + 1 :])
    return x[: shape[0], : shape[1]]
