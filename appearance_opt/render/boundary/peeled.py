"""Surfaces that are seen through, peeled layer by layer, with the derivative of all of them.

Every ray goes on behind what it met, through so many layers, which are then blended from the last
one on (depth peeling: Everitt 2001; blending: Porter and Duff 1984). A layer of colour c and
coverage a, reached by the share T of the light, changes its pixel by

    T a ((c, 1) - B),          B: what is seen behind it, premultiplied radiance and coverage,

and so the derivative of the pixel by all that the layer has is that of this term with T and B held
fixed. The backward pass shades all layers once more, and differentiates no other; what it needs of
a layer are 44 bytes. Silhouettes lie in every layer. What is blended jumps across them, and so it
does where two layers pass through each other, as they change places (``swaps``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays
from appearance_opt.render.boundary.edges import EdgePoints, Edges, Strata, place_points
from appearance_opt.render.boundary.estimator import Boundary, Estimator, Seen, changed_pixels
from appearance_opt.render.boundary.swaps import Pair, swaps
from appearance_opt.render.layers import LEAST, behind
from appearance_opt.render.passing import MISS
from appearance_opt.render.pixels import pixel_index
from appearance_opt.render.samples import Samples, Weighted, concat, join_arrays
from appearance_opt.render.shading import shade_layer
from appearance_opt.render.visibility import Visible

if TYPE_CHECKING:
    from appearance_opt.render.drawn import Drawn, Shown
    from appearance_opt.render.freezing import Run
    from appearance_opt.render.passing import Scene
    from appearance_opt.render.pixels import Batch
    from appearance_opt.render.sampling import Sampling

FAINTEST = 1e-4
"""Contrast, in any channel, below which an edge counts as hidden."""


@dataclass
class Layer:
    """What rays met in one layer. ``ray``: number of each ray; ``before``: its place in the list of
    the layer before; ``light``: share of the ray's light that gets there; ``color``, ``alpha``: of
    the surface; ``width``: of its footprint in pixels."""

    seen: Visible
    ray: mi.UInt32
    before: mi.UInt32
    light: mi.Float
    color: mi.Color3f
    alpha: mi.Float
    width: mi.Float


@dataclass(frozen=True)
class Peeled(Estimator):
    """``layers``: that a ray is followed through; what lies behind counts as background.
    ``samples``: camera rays in each pixel that an edge crosses; ``edges``: how silhouettes are
    sampled (None: not at all, and visibility has no gradient)."""

    layers: int = 8
    samples: int = 4
    edges: Edges | None = field(default_factory=Edges)

    def see(self, drawn: Drawn, batch: Batch, sampling: Sampling, seed: int, run: Run) -> Seen:
        """See ``Estimator``. No pixel is deferred."""
        width = dr.opaque(mi.Float, sampling.sample_width)
        points = self._silhouettes(drawn, batch, seed, width, run)
        grid = batch.grid
        crossed = changed_pixels([] if points is None else [points.pixel], grid.pixels)
        crossed = dr.gather(mi.Bool, crossed, grid.index)
        parts, weights = [], []
        for where, count in ((~crossed, sampling.samples), (crossed, self.samples)):
            index = dr.compress(where)
            if dr.width(index) == 0:
                continue
            ray = dr.arange(mi.UInt32, dr.width(index) * count)
            dr.eval(ray)
            view, x, y = run(rays.positions_in_pixels, batch, index, ray, count)
            parts.append(Samples(view, x, y, mi.UInt32(ray)))
            weights.append(dr.full(mi.Float, 1 / count, dr.width(ray)))
        every, weight = concat(parts), join_arrays(weights)
        dr.eval(every, weight)
        layers = self._peel(drawn, batch, every, dr.sqrt(weight) * width, run, beyond=True)
        colors, backs = blend(layers, dr.width(weight))
        image = dr.zeros(mi.Float, grid.pixels * 4)
        pixel = pixel_index(every, grid.rows)
        dr.scatter_reduce(dr.ReduceOp.Add, image, colors * weight, pixel)
        dr.eval(image)
        boundaries: list[Boundary] = [] if points is None else [points]
        changing = _pairs(layers, weight)
        found = (
            None
            if changing is None or self.edges is None
            else swaps(drawn.shown, batch, changing, run)
        )
        if found is not None:
            boundaries.append(found)
        places = dr.compress(crossed)
        return Seen(
            averaged=_join(layers, backs, weight, batch),
            whole=None,
            crossed=dr.gather(mi.UInt32, grid.index, places) if dr.width(places) else None,
            width=width,
            rays=self.samples,
            boundaries=boundaries,
            image=image,
        )

    def _silhouettes(
        self, drawn: Drawn, batch: Batch, seed: int, width: mi.Float, run: Run
    ) -> EdgePoints | None:
        """Points on the silhouettes of all layers, with their contrast; None without any that
        shows."""
        placed = None
        if self.edges is not None:
            placed = self.edges.spread(_placed, drawn.shown, drawn, batch, seed, run)
        if placed is None:
            return None
        points, within = placed
        kept = dr.compress(within)
        if dr.width(kept) == 0:
            return None
        points = points.keep(kept)
        count = dr.width(points.pixel)
        both = concat([points.inside, points.outside])
        wide = dr.zeros(mi.Float, 2 * count) + width
        colors, _ = blend(self._peel(drawn, batch, both, wide, run), 2 * count)
        i = dr.arange(mi.UInt32, count)
        contrast = mi.ArrayXf(
            [
                dr.gather(mi.Float, c, i) - dr.gather(mi.Float, c, i + dr.opaque(mi.UInt32, count))
                for c in colors
            ]
        )
        largest = mi.Float(0)
        for c in contrast:
            largest = dr.select(dr.abs(c) > largest, dr.abs(c), largest)
        shows = dr.compress(largest > FAINTEST)
        if dr.width(shows) == 0:
            return None
        points = replace(points.keep(shows), contrast=_take(contrast, shows))
        dr.eval(points)
        return points

    def _peel(
        self,
        drawn: Drawn,
        batch: Batch,
        every: Samples,
        width: mi.Float,
        run: Run,
        beyond: bool = False,
    ) -> list[Layer]:
        """Follow the rays of ``every`` sample (its triangle means nothing) through the layers;
        ``width``: of each ray's footprint in pixels. ``beyond``: also behind what hides all others,
        for they would be seen if it did not, and so its opacity has a derivative."""
        seen = run(_first, drawn.scene, batch, every)
        dr.eval(seen)
        index = dr.compress(seen.hit)
        ray, before = index, index
        light = dr.full(mi.Float, 1, dr.width(index))
        spare = light  # what would be left without the layer that keeps back most
        out: list[Layer] = []
        while dr.width(index):
            seen, wide = seen.keep(index), dr.gather(mi.Float, width, ray)
            dr.eval(seen, wide)
            color, alpha = run(shade_layer, drawn.shown, batch, seen.samples, wide)
            dr.eval(color, alpha)
            out.append(Layer(seen, ray, before, light, color, alpha, wide))
            if len(out) == self.layers:
                break
            spare = spare * (1 - alpha)
            spare, light = dr.select(spare > light, spare, light), light * (1 - alpha)
            on = dr.compress((spare if beyond else light) >= LEAST)
            if dr.width(on) == 0:
                break
            seen = seen.keep(on)
            dr.eval(seen)
            seen = run(behind, drawn.scene, batch, seen)
            dr.eval(seen)
            index = dr.compress(seen.hit)
            before = dr.gather(mi.UInt32, on, index)
            ray, light, spare = (
                dr.gather(mi.UInt32, ray, before),
                dr.gather(mi.Float, light, before),
                dr.gather(mi.Float, spare, before),
            )
            dr.eval(ray, before, light, spare)
        return out


def blend(layers: list[Layer], count: int) -> tuple[mi.ArrayXf, list[mi.ArrayXf]]:
    """Return (what each of ``count`` rays sees, what is seen behind each layer of each): from the
    last layer on; premultiplied RGB and coverage."""
    back, backs = None, []
    for k, layer in reversed(list(enumerate(layers))):
        here = dr.width(layer.ray)
        if back is None:
            back = mi.ArrayXf([dr.zeros(mi.Float, here) for _ in range(4)])
        backs.append(back)
        own = mi.ArrayXf([*layer.color, mi.Float(1)])
        total = back + (own - back) * layer.alpha
        up = dr.width(layers[k - 1].ray) if k else count
        back = mi.ArrayXf([_spread(c, layer.before, up) for c in total])
        dr.eval(back)
    if back is None:
        back = mi.ArrayXf([dr.zeros(mi.Float, count) for _ in range(4)])
    return back, backs[::-1]


def _spread(value: mi.Float, index: mi.UInt32, count: int) -> mi.Float:
    """Zeros, and the values at their index."""
    out = dr.zeros(mi.Float, count)
    dr.scatter(out, value, index, mode=dr.ReduceMode.Permute)
    return out


def _take(values: mi.ArrayXf, index: mi.UInt32) -> mi.ArrayXf:
    return mi.ArrayXf([dr.gather(mi.Float, v, index) for v in values])


def _join(
    layers: list[Layer], backs: list[mi.ArrayXf], weight: mi.Float, batch: Batch
) -> Weighted | None:
    """All layers of all rays, each with the share of its pixel that reaches it."""
    if not layers:
        return None
    samples = concat([layer.seen.samples for layer in layers])
    share = join_arrays([dr.gather(mi.Float, weight, n.ray) * n.light for n in layers])
    pixel = pixel_index(samples, batch.grid.rows)
    back = mi.ArrayXf([join_arrays([b[c] for b in backs]) for c in range(4)])
    wide = join_arrays([layer.width for layer in layers])
    dr.eval(samples, share, pixel, back, wide)
    return Weighted(samples, pixel, share, wide, back)


def _pairs(layers: list[Layer], weight: mi.Float) -> Pair | None:
    """Every two layers that follow each other on a ray; None without any."""
    found = []
    for front, back in zip(layers, layers[1:], strict=False):
        n = back.before
        alpha, light = dr.gather(mi.Float, front.alpha, n), dr.gather(mi.Float, front.light, n)
        jump = light * alpha * back.alpha
        first = mi.ArrayXf([dr.gather(mi.Float, c, n) for c in front.color])
        contrast = [(a - b) * jump for a, b in zip(first, back.color, strict=True)]
        share = dr.gather(mi.Float, weight, back.ray)
        found.append(Pair(front.seen.samples.keep(n), back.seen.samples, share, contrast))
    if not found:
        return None
    return Pair(
        concat([p.front for p in found]),
        concat([p.back for p in found]),
        join_arrays([p.share for p in found]),
        [join_arrays([p.contrast[c] for p in found]) for c in range(3)],
    )


def _first(scene: Scene, batch: Batch, every: Samples) -> Visible:
    """What rays meet first."""
    samples, depth = rays.trace_depth(scene, batch, every.view, every.x, every.y)
    return Visible(samples, depth, samples.triangle != MISS)


def _placed(
    shown: Shown, batch: Batch, strata: Strata, number: mi.UInt32, seed: mi.UInt32
) -> tuple[EdgePoints, mi.Bool]:
    """Points along all silhouettes, and whether they lie in the image."""
    return place_points(shown, batch, strata, number, seed)[:2]
