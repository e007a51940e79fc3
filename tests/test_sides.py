"""Single-sided faces: which backs matter, rays and triangles drawn onto pixels, gradients at their
silhouettes."""

from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from appearance_opt.asset.sides import counted, culled
from appearance_opt.asset.types import Material, Mesh
from appearance_opt.baking.occlusion import exposed
from appearance_opt.initial.sphere import sphere
from appearance_opt.render import raster, rays, upload
from appearance_opt.render.passing import MISS, SidedScene, blocked, meet
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.render.surface import Surface
from appearance_opt.views import Views, ViewSampler

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=3)


def sheet(n: int = 5, size: float = 1.0) -> tuple[NDArray, NDArray]:
    """A bent square of 2 n^2 triangles whose front looks along +z, turned to lie askew."""
    y, x = np.mgrid[0 : n + 1, 0 : n + 1] / n - 0.5
    p = np.stack([x, y, 0.3 * x * y], -1).reshape(-1, 3) * size
    i = np.arange(n * n)
    a = i // n * (n + 1) + i % n
    f = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    return (p @ turn).astype(np.float32), f


def ball(triangles: int = 300, radius: float = 1.0) -> tuple[NDArray, NDArray]:
    mesh = sphere(triangles, np.zeros(3), radius, 64)
    return mesh.positions, mesh.faces


def joined(*parts: tuple[NDArray, NDArray]) -> tuple[NDArray, NDArray]:
    start = np.cumsum([0] + [len(p) for p, _ in parts])
    faces = [f + s for (_, f), s in zip(parts, start, strict=False)]
    return np.concatenate([p for p, _ in parts]), np.concatenate(faces)


def seen(
    p: NDArray, f: NDArray, hidden: NDArray | None, views: Views, n: int = 64
) -> tuple[NDArray, NDArray]:
    """(views, pixels) triangles that rays meet, and that are drawn."""
    batch = Batch(views.records(), Grid(len(views), n))
    traced, _ = rays.trace_grid(upload.scene_of(p, f, hidden), batch)
    mask = None if hidden is None else mi.Bool(hidden)
    surface = Surface(upload.index_packets(f), upload.packets(8, p), culled=mask)
    drawn, _ = raster.draw_grid(surface, batch, mi.Float(0.5), mi.Float(0.5))
    return np.array(traced.triangle).reshape(len(views), -1), np.array(drawn.triangle).reshape(
        len(views), -1
    )


def test_only_backs_that_can_be_seen_need_anything() -> None:
    p, f = ball()
    all_ = np.ones(len(f), bool)
    assert culled(p, f, None) is None
    assert culled(p, f, ~all_) is None
    assert culled(p, f, all_) is None, "nobody sees a closed part from inside"
    assert culled(p, f[:, ::-1], all_).all(), "a room whose walls look inward"
    assert culled(p, f[1:], all_[1:]).all(), "a hole"
    turned = f.copy()
    turned[0] = turned[0, ::-1]
    assert culled(p, turned, all_).all(), "one face is turned over"
    both = joined((p, f), sheet(), (sheet()[0], sheet()[1][:, ::-1]))
    found = culled(*both, np.ones(len(both[1]), bool))
    np.testing.assert_array_equal(found, np.arange(len(both[1])) >= len(f))


def test_backs_in_sight_are_counted() -> None:
    def mesh(p: NDArray, f: NDArray, double_sided: bool) -> Mesh:
        return Mesh(p, f.astype(np.int32), material=Material(double_sided=double_sided))

    p, f = ball()
    closed, open_, both = mesh(p, f, False), mesh(p, f[1:], False), mesh(p, f, True)
    apart = mesh(p + np.float32(3), f[1:], False)
    assert counted(()) == counted((both,)) == (0, 0)
    assert counted((closed,)) == (len(f), 0)
    assert counted((closed, apart)) == (2 * len(f) - 1, len(f) - 1)
    assert counted((open_, both)) == (len(f) - 1, len(f) - 1)


def test_two_triangles_back_to_back_are_no_solid() -> None:
    p = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    f = np.array([[0, 1, 2], [0, 2, 1]])
    assert culled(p, f, np.ones(2, bool)).all()


@pytest.mark.parametrize("other_diagonals", [False, True])
def test_two_sheets_at_one_place_are_told_apart_by_the_side_they_look_to(
    other_diagonals: bool,
) -> None:
    p, f = sheet()
    if other_diagonals:  # flat, so that both lie at one place
        p = p - np.outer(p @ (normal := _normal(p, f)), normal).astype(np.float32)
    back = f[:, ::-1]
    if other_diagonals:
        quads = np.concatenate([f[: len(f) // 2], f[len(f) // 2 :, 2:]], axis=1)
        back = np.concatenate([quads[:, [0, 3, 1]], quads[:, [1, 3, 2]]])
    faces = np.concatenate([f, back])
    views = SAMPLER.draw(0, 8)
    traced, drawn = seen(p, faces, np.ones(len(faces), bool), views)
    eyes = views.eye
    for k in range(len(views)):
        towards = eyes[k] @ _normal(p, f) / np.linalg.norm(eyes[k])
        if abs(towards) < 0.2:  # it is bent: some of either side shows
            continue
        for triangle in (traced[k], drawn[k]):
            own = triangle[triangle != MISS] < len(f)
            assert len(own) > 50
            assert own.all() if towards > 0 else not own.any()
    assert (traced == drawn).mean() > 0.999


def _normal(p: NDArray, f: NDArray) -> NDArray:
    a, b, c = (p[f[:, k]].astype(np.float64) for k in range(3))
    n = np.cross(b - a, c - a).sum(axis=0)
    return n / np.linalg.norm(n)


def test_rays_go_on_behind_walls_that_look_inward() -> None:
    wall, small = ball(300, 1.0), ball(200, 0.5)
    p, f = joined((wall[0], wall[1][:, ::-1]), (small[0], small[1]))
    hidden = culled(p, f, np.ones(len(f), bool))
    assert hidden.sum() == len(wall[1])
    views = SAMPLER.draw(0, 4)
    traced, drawn = seen(p, f, hidden, views)
    outside, _ = seen(*small, None, views)
    assert ((traced != MISS) & (traced >= len(wall[1])) == (outside != MISS)).mean() > 0.999
    assert (traced == drawn).mean() > 0.999
    # through five shells in a row
    shells = joined(*((wall[0] * s, wall[1][:, ::-1]) for s in (1.0, 0.9, 0.8, 0.7, 0.6)), small)
    through, _ = seen(*shells, culled(*shells, np.ones(len(shells[1]), bool)), views)
    assert ((through >= 5 * len(wall[1])) & (through != MISS) == (outside != MISS)).mean() > 0.999


def test_what_can_be_seen_through_backs_is_exposed() -> None:
    wall, small = ball(300, 1.0), ball(200, 0.5)
    points = mi.Point3f((small[0] * np.float32(1.0001)).T)
    normal = mi.Vector3f(small[0].T / np.float32(0.5))
    active = dr.full(mi.Bool, True, len(small[0]))
    for faces, expected in ((wall[1][:, ::-1], True), (wall[1], False)):
        p, f = joined((wall[0], faces), small)
        scene = upload.scene_of(p, f, culled(p, f, np.ones(len(f), bool)))
        assert (
            np.array(exposed(partial(blocked, scene), points, normal, active, 4.0)).all()
            == expected
        )
    # the inner side of the walls is seen, their outer side is not
    p, f = wall[0], wall[1][:, ::-1]
    scene = upload.scene_of(p, f, culled(p, f, np.ones(len(f), bool)))
    corners = p[f]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    on, inward = mi.Point3f(corners.mean(axis=1).T), mi.Vector3f(flat.T)
    front_only = dr.full(mi.Bool, True, len(f))
    assert np.array(exposed(partial(blocked, scene), on, inward, front_only, 4.0, front_only)).all()
    solid = upload.scene_of(*wall)
    assert np.array(exposed(partial(blocked, solid), on, inward, front_only, 4.0)).all(), (
        "from either side"
    )
    # a ray in a thousand slips through an edge between two triangles
    assert (
        np.array(exposed(partial(blocked, solid), on, inward, front_only, 4.0, front_only)).mean()
        < 0.05
    )


def test_rays_stop_at_what_counts() -> None:
    shells = joined(*(ball(200, r) for r in (1.0, 0.75, 0.5)))
    count = len(shells[1]) // 3
    ray = mi.Ray3f(mi.Point3f([0, 0.1], [0, 0.1], [3, 3]), mi.Vector3f(0, 0, -1))
    for first in range(3):
        met = meet(upload.scene_of(*shells), ray, lambda m, d, k=first: m.triangle >= k * count)
        np.testing.assert_array_equal(np.array(met.triangle) // count, first)
    # layers one by one: from outside in, and out again
    layers, t = [], None
    for _ in range(7):
        met = meet(upload.scene_of(*shells), ray, after=t)
        layers.append(np.array(met.triangle)[0])
        t = met.t
    assert [x // count for x in layers[:6]] == [0, 1, 2, 2, 1, 0]
    assert layers[6] == MISS


def test_scenes_without_backs_are_plain() -> None:
    assert isinstance(upload.scene_of(*ball()), mi.Scene)
    assert isinstance(upload.MovingScene(*ball()).scene, mi.Scene)
    p, f = sheet()
    assert isinstance(upload.scene_of(p, f, np.ones(len(f), bool)), SidedScene)


def test_moving_sheets_turn_their_backs() -> None:
    p, f = sheet()
    batch = Batch(SAMPLER.draw(0, 4).records(), Grid(4, 32))
    moving = upload.MovingScene(p, f, np.ones(len(f), bool))

    def shown() -> NDArray:
        hit = np.array(rays.trace_grid(moving.scene, batch)[0].triangle) != MISS
        return hit.reshape(4, -1).any(axis=1)

    before = shown()
    assert before.any() and not before.all()
    moving.move(mi.Float((-p).ravel()))  # a mirrored sheet looks the other way
    mirrored = shown()
    moving.move(mi.Float(p.ravel()))
    np.testing.assert_array_equal(shown(), before)
    assert mirrored.any()
