"""Folders of pictures: cameras, crops, masks, lights, silhouettes, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from appearance_opt.asset.images import encode_png
from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.reference.folder import FolderReference
from appearance_opt.reference.silhouettes import Silhouettes
from appearance_opt.reference.subject import Subject
from appearance_opt.stages.hull import hull_surface
from appearance_opt.views import FIT, HELD_OUT, MEASURED, VALIDATION, ListedViews, ViewSampler
from scenes.shoot import frame_of, shoot, straight_png
from tests.test_fit_to_references import CENTRE, RADIUS, Ball

if TYPE_CHECKING:
    from pathlib import Path

    from appearance_opt.views import Views

COUNT, SIZE = 12, 64


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Views]:
    folder = tmp_path_factory.mktemp("shots")
    return folder, shoot(Ball(), folder, COUNT, SIZE, "point", exr=True, seed=1)


def table_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "transforms.json").read_text())


def write(source: Path, folder: Path, **changes: Any) -> Path:
    """The file with other values at the top, or under "frame0" in its first frame."""
    table = table_of(source)
    table["frames"][0] |= changes.pop("frame0", {})
    table |= changes
    for key in [k for k, v in table.items() if v is None]:
        del table[key]
    images = folder / "images"
    if not images.exists():
        images.mkdir()
        for image in (source / "images").iterdir():
            (images / image.name).write_bytes(image.read_bytes())
    path = folder / "transforms.json"
    path.write_text(json.dumps(table))
    return path


def test_pictures_are_what_their_camera_saw(shots: tuple[Path, Views]) -> None:
    folder, views = shots
    pictures = FolderReference(folder / "transforms.json")
    assert not pictures.static_light and not any(pictures.clipped)
    np.testing.assert_allclose(pictures.bounds, Ball.bounds, atol=1e-6)
    np.testing.assert_allclose(pictures.views.eye, views.eye, atol=1e-6)
    np.testing.assert_allclose(pictures.views.light, views.light, atol=1e-6)
    np.testing.assert_allclose(pictures.views.intensity, views.intensity, rtol=1e-6)
    same = pictures.render(views, SIZE)
    np.testing.assert_allclose(same, Ball().render(views, SIZE), atol=2e-3)
    # another perspective from the same eye: the ball fills the view
    image, truth = (r.render(pictures.views, 40) for r in (pictures, Ball()))
    assert 0.6 < truth[..., 3].mean() < np.pi / 4
    assert np.abs(image - truth).mean() < 0.01  # outlines are blurred by a pixel of the picture
    with pytest.raises(ReferenceRenderError, match="no picture from"):
        pictures.render(replace(views, eye=views.eye * 1.01), 8)


def test_images_need_not_be_square_nor_centred(shots: tuple[Path, Views], tmp_path: Path) -> None:
    """Rows and columns are cut off; the principal point says where the middle was."""
    _, views = shots
    (tmp_path / "images").mkdir()
    top, left, height, width = 6, 4, 52, 60
    frames = []
    for k, image in enumerate(Ball().render(views, SIZE)):
        name = f"images/{k}.png"
        cut = image[top : top + height, left : left + width]
        (tmp_path / name).write_bytes(straight_png(cut))
        frame = frame_of(views, k, name, "point")
        focal = SIZE / 2 / np.tan(frame.pop("camera_angle_x") / 2)
        frames.append({**frame, "fl_x": focal, "cx": SIZE / 2 - left, "cy": SIZE / 2 - top})
    table = {"up": "y", "w": width, "h": height, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    pictures = FolderReference(tmp_path / "transforms.json")
    image, truth = (r.render(pictures.views, 40) for r in (pictures, Ball()))
    assert np.abs(np.minimum(image, 1) - np.minimum(truth, 1)).mean() < 0.012


def test_what_the_border_cuts_off_is_left_out(shots: tuple[Path, Views], tmp_path: Path) -> None:
    """The square lies inside of the picture, where all of it is known."""
    _, views = shots
    (tmp_path / "images").mkdir()
    frames = []
    for k, image in enumerate(Ball().render(views, SIZE)):
        name = f"images/{k}.png"
        (tmp_path / name).write_bytes(straight_png(image[:, : SIZE // 2]))
        frame = frame_of(views, k, name, "static")
        focal = SIZE / 2 / np.tan(frame.pop("camera_angle_x") / 2)
        frames.append({**frame, "fl_x": focal, "cx": SIZE / 2})
    table = {"up": "y", "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    pictures = FolderReference(tmp_path / "transforms.json")
    assert all(pictures.clipped) and pictures.static_light
    image, truth = (r.render(pictures.views, 32) for r in (pictures, Ball()))
    assert np.abs(image[..., 3] - truth[..., 3]).mean() < 0.02
    found = Silhouettes.of(pictures.views, pictures.render(pictures.views, 96))
    assert found.open.all()
    low, high = found.bounds()
    assert (low < CENTRE - RADIUS).all() and (high > CENTRE + RADIUS).all()


def test_masks_and_up_and_names_of_nerf(shots: tuple[Path, Views], tmp_path: Path) -> None:
    folder, views = shots
    images = Ball().render(views, SIZE)
    path = write(folder, tmp_path, bounds=None)
    table = table_of(tmp_path)
    turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # y up to z up
    for k, frame in enumerate(table["frames"]):
        solid = np.clip(images[k] / np.maximum(images[k, ..., 3:], 1e-6), 0, 1)
        (tmp_path / f"{k}.png").write_bytes(straight_png(solid)[:0] or encode_png(
            (solid[..., :3] * 255).astype(np.uint8)))  # fmt: skip
        mask = (images[k, ..., 3] * 255 + 0.5).astype(np.uint8)
        (tmp_path / f"mask{k}.png").write_bytes(encode_png(mask[..., None]))
        frame |= {"file_path": f"./{k}", "mask_path": f"mask{k}.png"}
        frame["transform_matrix"] = (turn @ np.array(frame["transform_matrix"])).tolist()
        frame["light"]["position"] = (turn[:3, :3] @ frame["light"]["position"]).tolist()
    del table["up"]
    path.write_text(json.dumps(table))
    pictures = FolderReference(path)
    np.testing.assert_allclose(pictures.views.eye, views.eye, atol=1e-5)
    np.testing.assert_allclose(pictures.views.light, views.light, atol=1e-5)
    np.testing.assert_allclose(pictures.render(views, SIZE)[..., 3], images[..., 3], atol=4e-3)
    assert pictures.bounds is None
    subject = Subject.of_pictures(pictures)
    np.testing.assert_allclose(subject.placement.centre, CENTRE, atol=0.15 * RADIUS)
    assert subject.placement.scale == pytest.approx(RADIUS * 3**0.5, rel=0.2)


def test_a_list_of_views_is_split_by_a_rule(shots: tuple[Path, Views]) -> None:
    views = ViewSampler((0.0, 0.0, 0.0), 1.0).draw(0, 40)
    listed = ListedViews(views, np.zeros((1, 3)), seed=3)
    streams = {s: set(listed.held_out(s).numbers()) for s in (FIT, VALIDATION, MEASURED)}
    assert streams[VALIDATION] == {0, 16, 32} and streams[MEASURED] == {8, 24}
    assert streams[FIT] == {k for k in range(40) if k % HELD_OUT}
    assert listed.listed == 35

    def drawn(iteration: int) -> list[float]:
        return listed.draw(iteration, 5).eye[:, 0].tolist()

    first, second = ([x for i in r for x in drawn(i)] for r in (range(7), range(7, 14)))
    wanted = sorted(views.eye[sorted(streams[FIT]), 0].tolist())
    assert sorted(first) == wanted == sorted(second)
    assert first != second and drawn(3) == drawn(3)
    looks = listed.held_out(VALIDATION).draw(0, 8)
    assert len(looks) == 8 and len(np.unique(looks.eye[:, 0])) == 3


def test_the_hull_of_a_ball_is_the_ball() -> None:
    subject = Subject.of_reference(Ball())
    views = subject.sampler.draw(0, 20)
    silhouettes = Silhouettes.of(views, subject.reference.render(views, 80))
    low, high = silhouettes.bounds()
    radius = 1 / 3**0.5  # in units of the sphere around its box
    assert (low < -radius).all() and (low > -1.15 * radius).all() and (high < 1.15 * radius).all()
    p, f = hull_surface(silhouettes, subject.reference.bounds, 24)
    r = np.linalg.norm(p, axis=1) / radius
    assert r.mean() == pytest.approx(1, abs=0.02) and r.min() > 0.97 and r.max() < 1.12
    a, b, c = p[f].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.06)  # outward
    with pytest.raises(InputError, match="view 1 shows nothing"):
        Silhouettes.of(silhouettes.views[:2], np.ones((2, 4, 4, 4)) * [[[[1.0]]], [[[0.0]]]])
    shifted = replace(silhouettes.views, eye=silhouettes.views.eye + 10 * np.eye(20, 3, dtype="f4"))
    with pytest.raises(InputError, match="no volume in common"):
        replace(silhouettes, views=shifted).bounds()


BROKEN = [
    ({"frames": None}, "needs at least 4 images"),
    ({"frames": [1, 2, 3, 4]}, "frame 0: needs a file_path"),
    ({"frame0": {"file_path": "/etc/passwd"}}, "refers to '/etc/passwd'"),
    ({"frame0": {"file_path": "../../x.png"}}, "outside its own folder"),
    ({"frame0": {"file_path": "images/9999.exr"}}, "9999.exr', which does not exist"),
    ({"frame0": {"transform_matrix": [[1, 0], [0, 1]]}}, "transform_matrix: must be 4 x 4"),
    ({"frame0": {"transform_matrix": [[0] * 4] * 4}}, "transform_matrix: is no rotation"),
    ({"frame0": {"camera_angle_x": None}}, "camera_angle_x: must be a number"),
    ({"frame0": {"camera_angle_x": 4}}, "no angle below pi"),
    ({"frame0": {"light": None}}, "frame 0 has no light"),
    ({"frame0": {"light": "sun"}}, "light: must be static, or"),
    ({"frame0": {"light": {"type": "point", "intensity": 1}}}, "light: position: must be 3"),
    ({"frame0": {"light": {"type": "headlight", "intensity": -1}}}, "intensity: must be finite"),
    ({"frame0": {"mask_path": "images/0001.exr", "w": 32}}, "the image is 64 x 64, its camera 32"),
    ({"w": 80}, "frame 0 .*: the image is 64 x 64, its camera 80 x 64"),
    ({"k1": 0.1}, "lenses that distort"),
    ({"up": "x"}, "up: must be y or z"),
    ({"bounds": [[0, 0, 0], [0, 0, 0]]}, "bounds: the box is empty"),
    ({"bounds": [0, 1]}, "bounds: must be 2 x 3"),
]


@pytest.mark.parametrize(("changes", "message"), BROKEN)
def test_what_is_wrong_is_said_in_one_line(
    shots: tuple[Path, Views], tmp_path: Path, changes: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        FolderReference(write(shots[0], tmp_path, **changes))


def test_images_that_say_nothing_of_the_object_are_refused(
    shots: tuple[Path, Views], tmp_path: Path
) -> None:
    path = write(shots[0], tmp_path)
    first = tmp_path / "images" / "0000.exr"
    for pixels, message in (
        (np.zeros((SIZE, SIZE, 4), np.uint8), "frame 0 .* its mask is empty"),
        (np.zeros((SIZE, SIZE, 3), np.uint8), "has no alpha, and there is no mask_path"),
    ):
        first.write_bytes(encode_png(pixels))
        with pytest.raises(InputError, match=message):
            FolderReference(path)
    first.write_bytes(b"nonsense")
    with pytest.raises(InputError, match=r"0000\.exr"):
        FolderReference(path)
    path.write_text("{")
    with pytest.raises(InputError, match="is no JSON"):
        FolderReference(path)
    with pytest.raises(InputError, match="no such file"):
        FolderReference(tmp_path / "none.json")
