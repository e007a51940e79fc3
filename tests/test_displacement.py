"""Tessellated, displaced latents: topology, cracks, filtering, derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from appearance_opt.asset.normals import weld
from appearance_opt.baking.texel_points import texel_coverage
from appearance_opt.initial.sphere import sphere
from appearance_opt.latent.build import latent_of
from appearance_opt.latent.displacement import DISPLACEMENT, Tessellator, footprint, share
from appearance_opt.latent.latent import Latent
from appearance_opt.latent.mesh import LatentTopology
from appearance_opt.latent.parameter import Rates
from appearance_opt.latent.positions import POSITIONS
from appearance_opt.latent.subdivision import tessellate
from appearance_opt.latent.texels import TEXELS, TexelCodec, Texels
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.step import Gradients, StepInputs
from appearance_opt.reference.pool import Targets
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.pixels import Grid
from appearance_opt.render.quality import Quality
from appearance_opt.views import look_at

LEVELS = range(5)
SIZE = 64


def ball(triangles: int = 108, size: int = SIZE, seed: int = 0):
    """A closed mesh with seams, not quite round."""
    mesh = sphere(triangles, (0.0, 0.0, 0.0), 1.0, size)
    rng = np.random.default_rng(seed)
    mesh.positions[:] *= rng.uniform(0.93, 1.07, (len(mesh.positions), 1)).astype(np.float32)
    return mesh


def relief_of(image: np.ndarray):
    codec = TexelCodec((DISPLACEMENT,), len(image))
    return codec, codec.encode({DISPLACEMENT: image})


def noise(size: int = SIZE, amount: float = 0.1, seed: int = 0) -> np.ndarray:
    return (np.random.default_rng(seed).uniform(-amount, amount, (size, size))).astype(np.float32)


def smooth(size: int = SIZE, amount: float = 0.05) -> np.ndarray:
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    return (amount * np.sin(6 * np.pi * x / size) * np.cos(4 * np.pi * y / size)).astype(np.float32)


def posed(tessellator: Tessellator, mesh, image: np.ndarray) -> np.ndarray:
    codec, stored = relief_of(image)
    flat = mi.Float(np.ascontiguousarray(mesh.positions).ravel())
    return np.array(tessellator(flat, codec.layer(stored))).reshape(-1, 3)


def edge_uses(faces: np.ndarray) -> np.ndarray:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("level", LEVELS)
def test_new_vertices_are_means_of_two_parents(level: int) -> None:
    mesh = ball()
    fine = tessellate(mesh, level)
    assert len(fine.mesh.faces) == len(mesh.faces) * 4**level
    assert (
        len(fine.mesh.positions) - len(fine.mesh.faces) // 2 == 2
    )  # Euler's formula: still a sphere
    np.testing.assert_array_equal(fine.mesh.positions[: len(mesh.positions)], mesh.positions)
    assert np.all(fine.weights.sum(axis=1) == 1)  # dyadic: exact
    if level:
        coarse = tessellate(mesh, level - 1).mesh
        p, fp = coarse.positions, fine.mesh.positions
        corners = fine.mesh.faces.reshape(
            -1, 4, 3
        )  # children of each face; the middle one joins the midpoints
        for k in range(3):
            mean = (p[coarse.faces[:, k]] + p[coarse.faces[:, (k + 1) % 3]]) / 2
            # the weights are exact, their three products are rounded once each: measured 1.2e-7
            np.testing.assert_allclose(fp[corners[:, 3, k]], mean, atol=3e-7)


@pytest.mark.parametrize("level", LEVELS)
def test_texture_coordinates_stay_in_their_charts(level: int) -> None:
    mesh = ball()
    fine = tessellate(mesh, level).mesh
    np.testing.assert_array_equal(fine.frame_vertex[fine.frame_faces], fine.faces)
    assert np.unique(fine.frame_faces).size == len(fine.uvs)

    def area(m) -> np.ndarray:
        t = m.uvs[m.frame_faces].astype(np.float64)
        a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

    # the children of a face tile its image in the atlas: same orientation, a fraction of its area
    np.testing.assert_allclose(
        area(fine).reshape(len(mesh.faces), -1),
        np.repeat(area(mesh)[:, None] / 4**level, 4**level, 1),
        atol=1e-7,
    )


@pytest.mark.parametrize("level", LEVELS)
def test_no_crack_opens_at_any_level(level: int) -> None:
    mesh = ball()
    tessellator = Tessellator(mesh, level)
    fine = tessellator.mesh
    p = posed(tessellator, mesh, noise())
    assert (edge_uses(fine.faces) == 2).all()
    # as a file holds it: a vertex for each chart, joined by nothing but equal positions
    split = p[fine.frame_vertex]
    place = weld(split)[1]
    assert (edge_uses(place[fine.frame_faces]) == 2).all()
    assert (edge_uses(fine.frame_faces) == 1).any()  # there are seams to crack
    # and without the mean over a vertex's render vertices they would: its lookups do differ
    codec, stored = relief_of(noise())
    value = codec.layer(stored).pyramid.lookup(
        None, mi.Point2f(fine.uvs.T), mi.Float(footprint(fine))
    )[0]
    lone = p[fine.frame_vertex] + np.array(value)[:, None]
    assert (edge_uses(weld(lone.astype(np.float32))[1][fine.frame_faces]) == 1).any()


def test_displacement_follows_the_interpolated_normal() -> None:
    mesh = sphere(1200, (0.0, 0.0, 0.0), 1.0, SIZE)
    for level in (0, 2):
        tessellator = Tessellator(mesh, level)
        flat = tessellator.mesh.positions
        p = posed(tessellator, mesh, np.full((SIZE, SIZE), 0.25, np.float32))
        offset = p - flat
        np.testing.assert_allclose(np.linalg.norm(offset, axis=1), 0.25, atol=1e-6)
        radial = flat / np.linalg.norm(flat, axis=1, keepdims=True)
        # measured 0.0003: the angle between the mesh's normals and those of the sphere
        assert np.abs(np.sum(offset * radial, axis=1) - 0.25).max() < 1e-3


def test_vertices_read_the_mip_level_of_their_spacing() -> None:
    mesh = sphere(108, (0.0, 0.0, 0.0), 1.0, 256)
    y, x = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    finest = np.where((x + y) % 2, 0.2, -0.2).astype(
        np.float32
    )  # far finer than any edge: its mean is 0
    for level in (0, 1, 2):
        tessellator = Tessellator(mesh, level)
        fine = tessellator.mesh
        assert 256 * np.sqrt(footprint(fine).min()) > 2  # texels per half edge
        p = posed(tessellator, mesh, finest)
        # without filtering a vertex may read up to 0.2; measured 4e-9
        assert np.linalg.norm(p - fine.positions, axis=1).max() < 1e-5
    # a map with no more detail than the tessellation can hold is read as it is
    broad = (0.2 * np.sin(2 * np.pi * x / 256)).astype(np.float32)
    tessellator = Tessellator(mesh, 4)
    codec, stored = relief_of(broad)
    read = np.array(tessellator.amount(codec.layer(stored)))
    fine = tessellator.mesh
    expected = np.bincount(
        fine.frame_vertex, share(fine) * 0.2 * np.sin(2 * np.pi * (fine.uvs[:, 0] - 0.5 / 256))
    )
    rim = (
        np.bincount(fine.frame_vertex, np.abs(fine.uvs - 0.5).max(axis=1) > 0.5 - 2 / 256) > 0
    )  # clamped lookups
    np.testing.assert_allclose(read[~rim], expected[~rim], atol=3e-4)  # measured 6e-5


@pytest.mark.parametrize("level", [0, 1, 3])
@pytest.mark.parametrize("of", [POSITIONS, DISPLACEMENT])
def test_derivatives_of_the_displaced_surface(level: int, of: str) -> None:
    """Positions, normals and tangent bases of the displaced mesh by base vertices and by texels."""
    mesh = ball(48)
    tessellator = Tessellator(mesh, level)
    topology = LatentTopology(tessellator.mesh, tangents=True)
    codec, stored = relief_of(smooth())
    rng = np.random.default_rng(level)
    fine = tessellator.mesh
    weights = [
        rng.normal(size=8 * n).astype(np.float32) for n in (len(fine.positions), len(fine.uvs))
    ]
    start = {
        POSITIONS: np.ascontiguousarray(mesh.positions).ravel(),
        DISPLACEMENT: np.array(stored),
    }

    def buffers(p: mi.Float, layer) -> tuple[mi.Float, mi.Float]:
        surface = topology.surface(tessellator(p, layer))
        return surface.vertices, surface.frames

    p, layer = mi.Float(start[POSITIONS]), codec.layer(stored)
    dr.enable_grad(p, layer.pyramid.texels)
    dr.backward(
        sum(dr.sum(b * mi.Float(w)) for b, w in zip(buffers(p, layer), weights, strict=True))
    )
    analytic = {
        POSITIONS: dr.grad(p),
        DISPLACEMENT: codec.pull_back(dr.grad(layer.pyramid.texels), stored),
    }
    slope = np.array(analytic[of]).astype(np.float64)
    assert np.linalg.norm(slope) > 0
    for _ in range(3):
        direction = rng.normal(size=slope.shape).astype(np.float32)
        values = []
        for sign in (1, -1):
            moved = {**start, of: start[of] + np.float32(sign * 1e-3) * direction}
            both = buffers(mi.Float(moved[POSITIONS]), codec.layer(mi.Float(moved[DISPLACEMENT])))
            # summed in double precision: the sum is far larger than its change
            values.append(
                sum(np.array(b).astype(np.float64) @ w for b, w in zip(both, weights, strict=True))
            )
        numeric = (values[0] - values[1]) / 2e-3
        # measured 0.2 % of a typical direction's derivative, in float32
        assert abs(float(slope @ direction) - numeric) < 0.005 * np.linalg.norm(slope)


def inside_view(count: int = 2):
    """Cameras and lights inside a closed mesh: nothing but surface is seen, no silhouette moves, so
    that finite differences of the image are smooth."""
    eyes = np.array([[0.05, 0.02, 0.0], [-0.05, 0.0, 0.03]])[:count]
    targets = np.array([[1.0, 0.3, 0.2], [-0.4, -1.0, 0.5]])[:count]
    return look_at(eyes, targets, 60.0, np.array([[0.2, 0.3, 0.1], [-0.2, 0.1, 0.3]])[:count], 2.0)


def inside_model(
    fit: tuple[str, ...], level: int = 2, levels: tuple[int, ...] | None = None
) -> Latent:
    mesh = sphere(192, (0.0, 0.0, 0.0), 1.0, SIZE)
    flat = np.zeros((SIZE, SIZE), np.float32)
    # maps that jump across a seam would move a step in the image with it, which no derivative of
    # shading sees
    inside = distance_transform_edt(texel_coverage(mesh, SIZE)) - 2
    fade = np.clip(inside / 6, 0, 1).astype(np.float32)
    wave = smooth(SIZE, 0.2) * fade
    maps = {"red": 0.5 + wave, "green": 0.4 - wave, "blue": flat + 0.3, "roughness": flat + 0.7}
    maps.update(
        metalness=flat,
        normal_x=wave,
        normal_y=flat,
        normal_z=flat + 1,
        displacement=smooth(SIZE, 0.02) * fade,
    )
    return latent_of(mesh, maps, frozenset(fit), Rates(), levels or (level,))


@pytest.mark.parametrize("of", [POSITIONS, DISPLACEMENT, TEXELS])
def test_derivatives_of_the_image(of: str) -> None:
    """Base vertices, displacement texels and normal texels, through the whole renderer."""
    fitted = {POSITIONS: "shape", DISPLACEMENT: "displacement", TEXELS: "normal"}[of]
    model = inside_model((fitted,))
    assert set(model.parameters) == {of}
    views = inside_view()
    grid = Grid(2, 96)
    reference = mi.Float(np.tile(np.array([0.1, 0.1, 0.1, 1], np.float32), grid.pixels))
    inputs = StepInputs(views, Targets(reference), np.zeros((2, 3), np.float32), 0.0, 0.0, 3)
    quality = Quality(4, visibility=CameraRays(()))

    def run() -> tuple[float, dict]:
        loss, grads = Gradients(model, grid, quality, LOSSES["l2"], freeze=False)(inputs)
        return float(loss[0]), grads

    slope = np.array(run()[1][of]).astype(np.float64)
    parameter = model.parameters[of]
    start = np.array(parameter.value)
    for seed in range(3):
        # smooth directions: those that an optimiser takes
        direction = broad_direction(of, model, seed)
        values = []
        for sign in (1, -1):
            parameter.value = mi.Float(start + np.float32(sign * 5e-3) * direction)
            model.update_scene()
            values.append(run()[0])
        numeric = (values[0] - values[1]) / 1e-2
        predicted = float(slope @ direction)
        # measured 0.001 % (positions, displacement), 0.002 % (texels) of the largest derivative of
        # such a direction
        assert abs(predicted - numeric) < 2e-4 * np.linalg.norm(slope) * np.linalg.norm(direction)


def broad_direction(of: str, model: Latent, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if of == POSITIONS:
        p = model.mesh.positions.astype(np.float64)
        field = np.stack(
            [np.sin(p @ rng.normal(scale=2, size=3) + rng.uniform(0, 6)) for _ in range(3)], axis=1
        )
        return (0.3 * field).astype(np.float32).ravel()
    y, x = np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij")
    waves = [
        np.sin(2 * np.pi * (a * x + b * y) / SIZE + c) for a, b, c in rng.uniform(-3, 3, (3, 3))
    ]
    if of == DISPLACEMENT:
        return (0.3 * waves[0]).astype(np.float32).ravel()
    texels = model.fitted(Texels)
    assert texels is not None
    out = np.zeros((SIZE, SIZE, texels.codec.packed), np.float32)
    out[..., :3] = np.stack(waves, axis=-1)
    return out.ravel()
