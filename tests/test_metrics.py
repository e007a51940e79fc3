"""The metrics of a comparison, on images whose scores are known."""

from __future__ import annotations

from pathlib import Path

import flip_evaluator
import numpy as np
import pytest
from numpy.typing import NDArray

from appearance_opt.asset.images import encode_png
from appearance_opt.evaluate.metrics import BEST_PSNR, compare_images

GREY = 1.055 * 0.18 ** (1 / 2.4) - 0.055
"""What the background of linear 0.18 is on a screen: 0.4614."""


def linear(shown: NDArray | float) -> NDArray:
    """The radiance that an sRGB screen shows as this value in [0, 1] (IEC 61966-2-1, written
    out)."""
    shown = np.asarray(shown, np.float64)
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def image(
    shown: NDArray | float, coverage: NDArray | float = 1.0, size: int = 32
) -> NDArray[np.float32]:
    """(1, size, size, 4), premultiplied: ``shown`` is what a screen shows of the covered part of a
    pixel."""
    out = np.zeros((1, size, size, 4), np.float32)
    out[..., 3] = coverage
    out[..., :3] = linear(shown) * out[..., 3:]
    return out


def disc(radius: float, x: float, size: int = 64, fine: int = 32) -> NDArray[np.float32]:
    """Grey, its middle ``x`` pixels right of the image's; coverage by ``fine``^2 samples per
    pixel."""
    at = (np.arange(size * fine) + 0.5) / fine - size / 2
    inside = (at[None] - x) ** 2 + at[:, None] ** 2 < radius**2
    return image(0.5, inside.reshape(size, fine, size, fine).mean(axis=(1, 3)), size)


@pytest.mark.parametrize(("difference", "decibel"), [(0.1, 20.0), (0.01, 40.0)])
def test_psnr_of_a_constant_difference(difference: float, decibel: float) -> None:
    m = compare_images(image(0.5), image(0.5 + difference))
    # -10 log10(0.1^2) = 20
    assert m.psnr == pytest.approx(decibel, abs=1e-3)
    assert m.psnr_covered == pytest.approx(decibel, abs=1e-3)
    assert (m.silhouette_iou, m.silhouette_shift) == (1.0, 0.0)


def test_psnr_covered_leaves_out_what_neither_covers() -> None:
    """Quarters of the image: both cover it, the reference alone does, the candidate alone does,
    neither does."""
    column = np.arange(32) // 8
    reference = image(0.5, np.isin(column, (0, 1)))
    candidate = image(0.6, np.isin(column, (0, 2)))
    squares = 0.1**2, (0.5 - GREY) ** 2, (0.6 - GREY) ** 2
    m = compare_images(reference, candidate)
    assert m.psnr_covered == pytest.approx(-10 * np.log10(sum(squares) / 3), abs=1e-3)
    assert m.psnr == pytest.approx(-10 * np.log10(sum(squares) / 4), abs=1e-3)
    # radiance without coverage, which no mesh has, is seen over the whole image alone
    candidate[..., column == 3, :3] = linear(0.7) - 0.18
    bright = compare_images(reference, candidate)
    assert bright.psnr_covered == m.psnr_covered
    assert bright.psnr == pytest.approx(
        -10 * np.log10((sum(squares) + (0.7 - GREY) ** 2) / 4), abs=1e-3
    )


@pytest.mark.parametrize("shift", [1.0, 0.25])
def test_silhouettes_of_a_disc_that_is_shifted(shift: float) -> None:
    """Each of the 2 r rows loses ``shift`` pixels on one side and wins as many on the other, 4 r
    ``shift`` in all. The outline, counted in edges of pixels, is two for each row and each column,
    8 r: half of the shift."""
    radius = 20.0
    m = compare_images(disc(radius, 0.0), disc(radius, shift))
    # measured 0.4998 and 0.1250: coverage is counted in samples
    assert m.silhouette_shift == pytest.approx(shift / 2, rel=2e-3)


def test_intersection_over_union_of_a_disc_that_is_shifted() -> None:
    """By one pixel: pi r^2 - 2 r over pi r^2 + 2 r, where r is large enough for the count of pixels
    to be the area."""
    radius = 20.0
    m = compare_images(disc(radius, 0.0), disc(radius, 1.0))
    expected = (np.pi * radius - 2) / (np.pi * radius + 2)
    # measured 3.5e-4 apart
    assert m.silhouette_iou == pytest.approx(expected, abs=1e-3)


def test_flip_is_that_of_the_program_on_the_files_a_screen_would_show(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    a = np.kron(rng.integers(0, 256, (8, 8, 3)).astype(np.uint8), np.ones((8, 8, 1), np.uint8))
    b = 64 + a // 2
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path, pixels in zip(paths, (a, b), strict=True):
        path.write_bytes(encode_png(pixels))
    _, expected, _ = flip_evaluator.evaluate(*map(str, paths), "LDR")
    assert 0.1 < expected < 0.9
    ours = compare_images(*(image(pixels / 255, size=64) for pixels in (a, b)))
    assert ours.flip == pytest.approx(expected, abs=1e-6)  # measured 6e-8


def test_equal_images_and_means_over_views() -> None:
    a, b = image(0.5), image(0.6)
    m = compare_images(np.concatenate([a, a]), np.concatenate([a, b]))
    same, other = m.views
    assert (same.psnr, same.psnr_covered, same.flip) == (BEST_PSNR, BEST_PSNR, 0.0)
    assert (same.silhouette_iou, same.silhouette_shift) == (1.0, 0.0)
    assert m.psnr == pytest.approx((BEST_PSNR + 20.0) / 2, abs=1e-3)
    assert m.flip == pytest.approx(other.flip / 2)
    with pytest.raises(ValueError, match="differ in shape"):
        compare_images(a, a[:, :16])


def test_views_are_judged_each_by_itself() -> None:
    """Those of a batch lie side by side while FLIP looks at them."""
    rng = np.random.default_rng(0)
    first = rng.random((3, 40, 40, 4)).astype(np.float32)
    first[..., 3] = 1
    second = first * np.float32([[[[0.99, 1, 1, 1]]]])
    second[1] = 0
    together = compare_images(first, second)
    for k, view in enumerate(together.views):
        alone = compare_images(first[k : k + 1], second[k : k + 1]).views[0]
        assert alone == view
    assert [v.noticed for v in together.views] == [0.0, 1.0, 0.0]
