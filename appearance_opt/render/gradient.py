"""One differentiable batch of images: forward now, gradients when the caller knows dLoss/dImage.

Between the two stands the loss, which is a function of whole pixels. So the backward pass shades the same
samples again, with gradients, and pulls back

    sum over samples  weight * <dLoss/dI(pixel), colour>                      (interior)
  + sum over silhouette points  length * <dLoss/dI(pixel), c_in - c_out> n.x  (visibility),

everything but the surface's buffers held fixed. The image itself is never differentiated.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.render import rays, silhouette
from appearance_opt.render.deferred import Grid, pixel_index, shade
from appearance_opt.render.material import MaterialMaps
from appearance_opt.render.rays import MISS, Samples
from appearance_opt.render.silhouette import EdgeList, EdgeSamples
from appearance_opt.render.surface import Surface


@dataclass(frozen=True)
class Quality:
    """How finely visibility is sampled. ``edge_density``: silhouette points per pixel of silhouette
    (0: no visibility gradient); ``edge_samples``: camera rays in each pixel that a silhouette crosses
    (all other pixels take one)."""

    edge_density: float = 1.0
    edge_samples: int = 8
    samples: int = 1
    sample_width: float = 0.7


@dataclass
class Frame:
    """A rendered batch and what its backward pass needs.

    ``image``: (pixels * 4) premultiplied linear radiance and coverage. ``samples``: the covered camera
    rays with their ``pixel`` and ``weight``; None where nothing was hit. ``edges``: visible silhouette
    points, None without any; ``contrast``: c_in - c_out at them, premultiplied RGB and coverage.
    """

    grid: Grid
    records: mi.Float
    image: mi.Float
    samples: Samples | None
    pixel: mi.UInt32 | None
    weight: mi.Float | None
    edges: EdgeSamples | None
    contrast: mi.ArrayXf | None


def render(
    scene: mi.Scene,
    surface: Surface,
    maps: MaterialMaps,
    edge_list: EdgeList | None,
    records: mi.Float,
    grid: Grid,
    quality: Quality,
    seed: int,
) -> Frame:
    """Forward pass, without gradients (``surface`` and ``maps`` are read detached)."""
    with dr.suspend_grad():
        edges = None
        if edge_list is not None and quality.edge_density > 0:
            edges = silhouette.sample_edges(
                scene, edge_list, surface.vertices, records, grid, quality.edge_density, seed
            )
        samples, pixel, weight = _camera_samples(scene, records, grid, edges, quality)
        image = dr.zeros(mi.Float, grid.pixels * 4)
        if samples is not None:
            c = shade(surface, maps, records, samples, grid.size, _width(weight, quality))
            value = mi.ArrayXf([c.x * weight, c.y * weight, c.z * weight, weight])
            dr.scatter_reduce(dr.ReduceOp.Add, image, value, pixel, mode=dr.ReduceMode.Local)
        contrast = None if edges is None else _contrast(surface, maps, records, edges, grid.size)
        dr.eval(image, contrast)
    return Frame(grid, records, image, samples, pixel, weight, edges, contrast)


def surrogate(
    frame: Frame,
    surface: Surface,
    maps: MaterialMaps,
    edge_list: EdgeList | None,
    image_gradient: mi.Float,
    quality: Quality,
) -> mi.Float:
    """Scalar whose derivative is the loss's, for ``image_gradient`` = dLoss/dImage (pixels * 4).

    Only its gradient means anything. Zero width-1 array when the frame is empty.
    """
    size = frame.grid.size
    total = mi.Float(0)
    if frame.samples is not None:
        assert frame.pixel is not None and frame.weight is not None
        color = shade(surface, maps, frame.records, frame.samples, size, _width(frame.weight, quality))
        g = _pixel(image_gradient, frame.pixel)
        total += dr.sum(dr.fma(g[0], color.x, dr.fma(g[1], color.y, g[2] * color.z)) * frame.weight)
    if frame.edges is not None and edge_list is not None and dr.grad_enabled(surface.vertices):
        assert frame.contrast is not None
        g, c = _pixel(image_gradient, frame.edges.pixel), frame.contrast
        jump = dr.fma(g[0], c[0], dr.fma(g[1], c[1], dr.fma(g[2], c[2], g[3] * c[3]))) * frame.edges.length
        moved = silhouette.motion(edge_list, surface.vertices, frame.records, frame.edges, size)
        total += dr.sum(jump * moved)
    return total


def _width(weight: mi.Float, quality: Quality) -> mi.Float:
    """Width in pixels of camera samples with the given share of their pixel."""
    return dr.sqrt(weight) * dr.opaque(mi.Float, quality.sample_width)


def _camera_samples(
    scene: mi.Scene,
    records: mi.Float,
    grid: Grid,
    edges: EdgeSamples | None,
    quality: Quality,
) -> tuple[Samples | None, mi.UInt32 | None, mi.Float | None]:
    """Covered camera rays: ``samples`` in each pixel, ``edge_samples`` where a silhouette passes."""
    crossed = dr.zeros(mi.Bool, grid.pixels)
    if edges is not None:
        dr.scatter(crossed, mi.Bool(True), edges.pixel)
    pixel = (grid.view * grid.rows + grid.row) * grid.rows + grid.column
    on_edge = dr.gather(mi.Bool, crossed, pixel)
    parts, weights = [], []
    for dx, dy in rays.sub_pixel_offsets(quality.samples):
        x, y = mi.Float(grid.column) + dr.opaque(mi.Float, dx), mi.Float(grid.row) + dr.opaque(mi.Float, dy)
        hits = rays.trace(scene, records, grid.view, x, y, grid.size)
        dr.eval(hits, on_edge)
        parts.append(rays.keep(hits, dr.compress((hits.triangle != MISS) & ~on_edge)))
        weights.append(1 / quality.samples)
    if edges is not None:
        parts.append(_fine_samples(scene, records, grid, dr.compress(on_edge), quality.edge_samples))
        weights.append(1 / quality.edge_samples)
    parts_weights = [(p, w) for p, w in zip(parts, weights, strict=True) if dr.width(p.triangle)]
    if not parts_weights:
        return None, None, None
    samples = _concat([p for p, _ in parts_weights])
    weight = _joined([dr.full(mi.Float, w, dr.width(p.triangle)) for p, w in parts_weights])
    dr.eval(samples, weight)
    return samples, pixel_index(samples, grid.rows), weight


def _fine_samples(scene: mi.Scene, records: mi.Float, grid: Grid, index: mi.UInt32, count: int) -> Samples:
    """The hits among ``count`` rays in each of the given pixels."""
    offsets = mi.Float(rays.sub_pixel_offsets(count).ravel())
    i = dr.arange(mi.UInt32, dr.width(index) * count)
    k = i // count
    at = dr.gather(mi.UInt32, index, k)
    offset = 2 * (i - k * count)
    x = mi.Float(dr.gather(mi.UInt32, grid.column, at)) + dr.gather(mi.Float, offsets, offset)
    y = mi.Float(dr.gather(mi.UInt32, grid.row, at)) + dr.gather(mi.Float, offsets, offset + 1)
    fine = rays.trace(scene, records, dr.gather(mi.UInt32, grid.view, at), x, y, grid.size)
    return rays.keep(fine, dr.compress(fine.triangle != MISS))


def _concat(parts: list[Samples]) -> Samples:
    if len(parts) == 1:
        return parts[0]
    return Samples(*(_joined([getattr(p, f) for p in parts]) for f in ("view", "x", "y", "triangle")))


def _joined(parts: list[mi.Float]) -> mi.Float:
    """Arrays one after the other. ``dr.concat`` would write their widths, which change every step, into the
    kernel and so compile one every step."""
    out = dr.empty(type(parts[0]), sum(dr.width(p) for p in parts))
    offset = 0
    for part in parts:
        index = dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, offset)
        dr.scatter(out, part, index, mode=dr.ReduceMode.Permute)
        offset += dr.width(part)
    return out


def _contrast(
    surface: Surface, maps: MaterialMaps, records: mi.Float, edges: EdgeSamples, size: mi.Float
) -> mi.ArrayXf:
    """c_in - c_out at the silhouette points: premultiplied RGB and coverage."""
    both = _concat([edges.inside, edges.outside])
    covered = both.triangle != MISS
    both = Samples(both.view, both.x, both.y, dr.select(covered, both.triangle, 0))
    color = shade(surface, maps, records, both, size, dr.opaque(mi.Float, 1.0)) & covered
    alpha = dr.select(covered, mi.Float(1), 0)
    dr.eval(color, alpha)
    n = dr.width(edges.edge)
    inner, outer = dr.arange(mi.UInt32, n), dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, n)
    return mi.ArrayXf(
        [dr.gather(mi.Float, c, inner) - dr.gather(mi.Float, c, outer) for c in (color.x, color.y, color.z, alpha)]
    )


def _pixel(image: mi.Float, index: mi.UInt32) -> mi.ArrayXf:
    return dr.gather(mi.ArrayXf, image, index, shape=(4, dr.width(index)))
