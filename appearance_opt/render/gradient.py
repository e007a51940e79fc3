"""One differentiable batch of images: forward now, gradients when the caller knows dLoss/dImage.

Between the two stands the loss, which is a function of whole pixels. So the backward pass shades
the same samples again, with gradients, and pulls back

    sum over samples  weight * <dLoss/dI(pixel), colour>                        (interior)
  + sum over points of boundaries  measure * <dLoss/dI(pixel), contrast> motion (visibility),

everything but the surface's buffers held fixed. The image itself is never differentiated. Which
samples and boundaries there are is up to ``Quality.visibility`` (see ``boundary``).

Most pixels hold no boundary, and a few samples: their colour is the mean of these. When the loss is
a sum over pixels, ``Sampling.defer`` leaves them out, and ``direct`` shades them, takes the loss
and goes back in one kernel: half the work.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

# not only for the type checker: Dr.Jit resolves the annotations of data classes when it looks for
# arrays
from appearance_opt.render.boundary.estimator import Seen
from appearance_opt.render.freezing import traced
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import Batch, add_colors
from appearance_opt.render.samples import Samples
from appearance_opt.render.shading import shade, shade_layer

if TYPE_CHECKING:
    from collections.abc import Callable

    from appearance_opt.render.boundary.estimator import Boundary
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.quality import Quality


DEFERRED = 4
"""``Sampling.defer`` of those who call ``direct``: its kernel shades each sample of a pixel in code
of its own."""


@dataclass
class RenderedBatch:
    """A rendered batch and what its backward pass needs. ``image``: (pixels * 4) premultiplied
    linear radiance and coverage, without the deferred pixels; ``seen``: of what."""

    batch: Batch
    image: mi.Float
    seen: Seen

    def complete(self) -> mi.Bool | None:
        """Mark (pixels,) which pixels of the image are not deferred; None if none is."""
        if self.seen.whole is None:
            return None
        out = dr.full(mi.Bool, True, self.batch.grid.pixels)
        dr.scatter(out, mi.Bool(False), self.seen.whole.pixel)
        return out


def render(
    drawn: Drawn, batch: Batch, quality: Quality, seed: int, run: Run = traced
) -> RenderedBatch:
    """Run the forward pass, without gradients (``drawn`` is read detached). ``run``: how its stages
    are called (see ``freezing``)."""
    with dr.suspend_grad():
        seen = quality.visibility.see(drawn, batch, quality, seed, run)
        image, contrasts = run(_averages, drawn.shown, batch, seen)
        dr.eval(image, contrasts)
    shaded = zip(seen.boundaries, contrasts, strict=True)
    return RenderedBatch(
        batch, image, replace(seen, boundaries=[_with_contrast(b, c) for b, c in shaded])
    )


def _averages(shown: Shown, batch: Batch, seen: Seen) -> tuple[mi.Float, list[mi.ArrayXf]]:
    """(image without the deferred pixels, contrast of each boundary)."""
    image = dr.zeros(mi.Float, batch.grid.pixels * 4) if seen.image is None else seen.image
    if (averaged := seen.averaged) is not None and seen.image is None:
        color = shade(shown, batch, averaged.samples, averaged.width)
        add_colors(image, color, averaged.weight, averaged.pixel, dr.ReduceMode.Local)
    contrasts = [
        _contrast(shown, batch, b, seen.width) if b.contrast is None else b.contrast
        for b in seen.boundaries
    ]
    if seen.rays is not None and contrasts:
        dr.eval(image, contrasts)
        for boundary, contrast in zip(seen.boundaries, contrasts, strict=True):
            image = _with_contrast(boundary, contrast).corrected(image, seen.rays, batch.grid)
    return image, contrasts


def direct(
    rendered: RenderedBatch,
    shown: Shown,
    pixel_loss: Callable[[mi.Color3f, mi.UInt32], mi.Float],
) -> mi.Float | None:
    """Return the loss of each deferred pixel, differentiable: ``pixel_loss(radiance, pixel)`` of
    its radiance (all deferred pixels are fully covered). None without any."""
    if (whole := rendered.seen.whole) is None:
        return None
    colors = [shade(shown, rendered.batch, r, whole.width) for r in whole.rays]
    return pixel_loss(sum(colors[1:], colors[0]) * (1 / len(colors)), whole.pixel)


def surrogate(rendered: RenderedBatch, shown: Shown, image_gradient: mi.Float) -> list[mi.Float]:
    """Return arrays whose sums have the loss's derivative, for ``image_gradient`` = dLoss/dImage
    (pixels * 4).

    Only their gradients mean anything: pass them to ``backward``. They are not summed here, as a
    sum would evaluate them and make the backward pass shade once more. Empty when the batch is.
    """
    terms, batch, seen = [], rendered.batch, rendered.seen
    if (averaged := seen.averaged) is not None:
        g = _pixel(image_gradient, averaged.pixel)
        if averaged.behind is None:
            color = shade(shown, batch, averaged.samples, averaged.width)
            product = dr.fma(g[0], color.x, dr.fma(g[1], color.y, g[2] * color.z))
        else:
            # a layer covers what is behind it: alpha (c - behind), with what is behind held fixed
            color, alpha = shade_layer(shown, batch, averaged.samples, averaged.width)
            b = averaged.behind
            product = dr.fma(g[0], color.x - b[0], g[1] * (color.y - b[1]))
            product = dr.fma(g[2], color.z - b[2], dr.fma(g[3], 1 - b[3], product)) * alpha
        terms.append(product * averaged.weight)
    if dr.grad_enabled(shown.surface.vertices):
        for b in seen.boundaries:
            # what the loss loses where the boundary moves by a pixel
            g, c = _pixel(image_gradient, b.pixel), b.contrast
            assert c is not None
            jump = dr.fma(g[0], c[0], dr.fma(g[1], c[1], dr.fma(g[2], c[2], g[3] * c[3])))
            terms.append(jump * b.measure * b.motion(shown, batch))
    return terms


def backward(terms: list[mi.Float]) -> None:
    """Propagate the gradient of the sum of all entries of all arrays, in one traversal."""
    moving = [t for t in terms if dr.grad_enabled(t)]
    for term in moving:
        dr.set_grad(term, 1.0)
        dr.enqueue(dr.ADMode.Backward, term)
    if moving:
        dr.traverse(dr.ADMode.Backward)


def _contrast(shown: Shown, batch: Batch, boundary: Boundary, width: mi.Float) -> mi.ArrayXf:
    """Colour inside less that outside: premultiplied RGB and coverage. ``width`` of the texture
    filter in pixels."""

    def colour(side: Samples) -> mi.ArrayXf:
        covered = side.triangle != MISS
        hits = Samples(side.view, side.x, side.y, dr.select(covered, side.triangle, 0))
        color = shade(shown, batch, hits, width) & covered
        return mi.ArrayXf([color.x, color.y, color.z, dr.select(covered, mi.Float(1), 0)])

    return colour(boundary.inside) - colour(boundary.outside)


def _with_contrast(boundary: Boundary, contrast: mi.ArrayXf) -> Boundary:
    return replace(boundary, contrast=contrast)  # type: ignore[type-var]


def _pixel(image: mi.Float, index: mi.UInt32) -> mi.ArrayXf:
    return dr.gather(mi.ArrayXf, image, index, shape=(4, dr.width(index)))
