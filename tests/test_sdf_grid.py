"""Distance fields on grids: between their values, and what is no grid."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from appearance_opt.errors import InputError
from appearance_opt.reference.sdf import SdfReference
from appearance_opt.sdf.check import check
from appearance_opt.sdf.grid import GridField, make_grid, read_grid
from appearance_opt.sdf.normals import derivative, differences
from appearance_opt.sdf.shape import Placed
from appearance_opt.views import ViewSampler

LOW, SPACING, SHAPE = np.array((-1.0, -0.9, -0.8)), np.array((0.1, 0.09, 0.08)), (21, 21, 21)
AT = np.stack(np.meshgrid(*(low + s * np.arange(n) for low, s, n in
                            zip(LOW, SPACING, SHAPE, strict=True)), indexing="ij"), -1)  # fmt: skip
BALL = np.linalg.norm(AT, axis=-1) - 0.6


def arrays(**others: np.ndarray) -> dict[str, np.ndarray]:
    return {"distance": BALL, "spacing": SPACING, "origin": LOW, **others}


def inside(count: int = 500) -> mi.Point3f:
    p = np.random.default_rng(0).uniform(LOW, LOW + SPACING * 20, (count, 3))
    return mi.Point3f(p.T.astype(np.float32))


@pytest.mark.parametrize("cubic", [False, True])
def test_values_are_met_and_lines_are_straight(cubic: bool) -> None:
    line = AT @ (0.3, -0.5, 0.7) + 0.1
    field = GridField(line.astype(np.float32), SPACING, LOW, cubic=cubic)
    nodes = mi.Point3f(AT.reshape(-1, 3).T.astype(np.float32))
    np.testing.assert_allclose(np.array(field.distance(nodes)), line.ravel(), atol=2e-5)
    middle = (AT[7:13, 7:13, 7:13] + SPACING * 0.3).reshape(-1, 3)  # away from mirrored borders
    found = np.array(field.distance(mi.Point3f(middle.T.astype(np.float32))))
    np.testing.assert_allclose(found, middle @ (0.3, -0.5, 0.7) + 0.1, atol=1e-4)
    np.testing.assert_allclose(field.bounds, [LOW, LOW + SPACING * 20])


def test_cubic_is_closer_to_what_is_smooth() -> None:
    p = inside()
    true = np.linalg.norm(np.array(p), axis=0) - 0.6
    far = true > -0.4  # the middle of a ball is a tip
    off = []
    for kind in ("linear", "cubic"):
        field = make_grid(arrays(interpolation=np.array(kind)), "it")
        off.append(np.abs(np.array(field.distance(p)) - true)[far].mean())
        slopes = np.array(derivative(field.distance, p)), np.array(differences(field.distance, p))
        assert np.quantile(np.abs(slopes[0] - slopes[1]), 0.95) < 0.01
    assert off[1] < 0.3 * off[0]


def test_files_are_read_whatever_their_type_and_order(tmp_path: Path) -> None:
    color = np.clip(AT * 0.4 + 0.5, 0, 1)
    p = inside()
    expected = np.array(make_grid(arrays(), "it").distance(p))
    for kind in ("<f4", ">f4", "<f8", "<f2"):
        np.savez(tmp_path / "a.npz", **arrays(distance=BALL.astype(kind)), color=color, other=[1])
        field = read_grid(tmp_path / "a.npz")
        np.testing.assert_allclose(np.array(field.distance(p)), expected, atol=1e-3)
    look = field.material(p)
    np.testing.assert_allclose(np.array(look.base_color), np.array(p) * 0.4 + 0.5, atol=1e-5)
    np.testing.assert_allclose(np.array(look.roughness), 0.5, atol=1e-6)
    bytes_ = np.full((*SHAPE, 3), 188, np.uint8)
    made = make_grid(arrays(color=bytes_, metalness=np.ones(SHAPE)), "it").material(p)
    np.testing.assert_allclose(np.array(made.base_color), 0.503, atol=1e-3)
    np.testing.assert_allclose(np.array(made.metalness), 1.0, atol=1e-6)


def test_a_grid_is_drawn() -> None:
    placed = Placed(make_grid(arrays(), "it"), (0.0, 0.0, 0.0), 1.0)
    checked = check(placed, "it")
    np.testing.assert_allclose(np.linalg.norm(checked.points, axis=1), 0.6, atol=5e-3)
    image = SdfReference(placed, checked.tracing).render(
        ViewSampler((0.0, 0.0, 0.0), 0.6).draw(0, 1), 64, 4
    )
    # the ball fills the image but for a margin of 2 %
    assert image[..., 3].mean() == pytest.approx(np.pi / 4 / 1.02**2, rel=0.02)


NAN = BALL.copy()
NAN[3, 4, 5] = np.nan


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"distance": None}, "has no 'distance'"),
        ({"spacing": None}, "has no 'spacing'"),
        ({"distance": BALL[0]}, r"shape \(21, 21\): it must be \(X, Y, Z\)"),
        ({"distance": BALL[:2]}, "at least 4"),
        ({"distance": (BALL > 0).astype(int)}, "holds int64: it must hold floats"),
        ({"distance": NAN}, r"not a finite number at \[3, 4, 5\]"),
        ({"distance": BALL.astype("<f4").view(">f4")}, "byte order|not a finite"),
        ({"spacing": np.array([1.0, 2.0])}, "'spacing' must be three"),
        ({"spacing": np.array(-1.0)}, "above zero"),
        ({"spacing": np.array("far")}, "'spacing' must be three"),
        ({"origin": np.array(1.0)}, "'origin' must be three"),
        ({"color": np.zeros((3, 3, 3, 3))}, r"must be \(21, 21, 21, 3\)"),
        ({"roughness": np.zeros((21, 21, 21, 1))}, r"must be \(21, 21, 21\)"),
        ({"interpolation": np.array("nearest")}, "must be linear or cubic"),
        ({"distance": np.array([{}])}, "pickled objects, which are never opened"),
    ],
)
def test_what_is_no_grid_is_refused(
    given: dict[str, np.ndarray | None], words: str, tmp_path: Path
) -> None:
    held = {k: v for k, v in {**arrays(), **given}.items() if v is not None}
    np.savez(tmp_path / "a.npz", **held)
    with pytest.raises(InputError, match=words) as refused:
        read_grid(tmp_path / "a.npz")
    assert "a.npz: " in str(refused.value) and "\n" not in str(refused.value)


def test_broken_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_grid(tmp_path / "none.npz")
    (tmp_path / "a.npz").write_bytes(b"no archive at all")
    with pytest.raises(InputError, match="its structure is broken"):
        read_grid(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **arrays())
    whole = (tmp_path / "b.npz").read_bytes()
    (tmp_path / "b.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="its structure is broken"):
        read_grid(tmp_path / "b.npz")
