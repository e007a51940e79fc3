"""The page of a report: what it says, what it holds, and that it needs nothing from outside."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset.images import decode
from appearance_opt.asset.types import Asset, Material, Texture
from appearance_opt.evaluate import preview, three
from appearance_opt.evaluate.hero import hero_view
from appearance_opt.evaluate.metrics import compare_images, halve
from appearance_opt.evaluate.pictures import encode_for_page, shrink
from appearance_opt.evaluate.report import Option, ReportData, page, verdict
from appearance_opt.evaluate.showing import Looks, show
from appearance_opt.evaluate.sizes import in_bytes, sizes_of
from appearance_opt.evaluate.verdict import AtSize, at_sizes, describe_visibility, percent
from appearance_opt.reference.mesh import MeshReference
from appearance_opt.views import Views, support, views_around
from tests.conftest import make_asset

VOID = {"meta", "img", "input", "br", "link"}


class Page(HTMLParser):
    """Its elements; fails where one is closed that is not open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}>"

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.seen if name == tag]


def picture(value: int) -> np.ndarray:
    return np.full((32, 32, 3), value, np.uint8)


def small_data(ball: Asset) -> ReportData:
    low = make_asset(8, 16)
    views = [{"reference": picture(90), "result": picture(100), "wireframe": picture(50)}] * 2
    return ReportData(
        title="ball </script><b>: 2,208 to 224",
        facts={"steps": 3},
        metrics={},
        views=views,
        maps={"normal": picture(128)},
        captions=["under a sky", "a view"],
        by_size=[AtSize(96, 0.2, 30.0, 0.1), AtSize(48, 0.004, 40.0, 0.01)],
        sizes={"original": sizes_of(ball), "result": sizes_of(low)},
        previews={"original": preview.preview_of(ball), "result": preview.preview_of(low)},
        links={"low poly.glb": "../low poly.glb"},
        options=[Option("--seed", 0, "Of everything random.", True)],
    )


def test_a_page_is_whole_and_needs_nothing_from_outside(ball: Asset) -> None:
    data = small_data(ball)
    text = page(data)
    shown = Page(text)
    assert not shown.open
    for tag in ("img", "script", "link", "iframe"):
        for attributes in shown.all(tag):
            assert (attributes.get("src") or "data:").startswith("data:"), attributes
            assert "href" not in attributes
    assert "http" not in re.sub(r"[A-Za-z0-9+/=]{200,}", "", text)
    # everything that can be operated has a name, and pictures have words
    ids = {a.get("id") for _, a in shown.seen}
    assert {"pictures", "viewer", "cut", "gain", "closer", "three-js", "sky"} <= ids
    assert all(a.get("alt") for a in shown.all("img"))
    assert {a.get("href") for a in shown.all("a")} >= {"../low%20poly.glb", "map_normal.png"}
    assert "&lt;/script&gt;&lt;b&gt;" in text and "width=device-width" in text
    assert "prefers-color-scheme: dark" in text and ":focus-visible" in text


def test_the_viewer_holds_both_assets(ball: Asset) -> None:
    text = page(small_data(ball))
    scripts = re.findall(r"<script type='(.*?)'(.*?)>(.*?)</script>", text, re.S)
    by_name = {re.sub(r".*'(.*)'", r"\1", more): content for _, more, content in scripts}
    library = gzip.decompress(base64.b64decode(by_name["three-js"])).decode()
    assert library == three.library() and "PMREMGenerator" in library and "@license" in library
    for name, triangles in (("original", ball.triangle_count), ("result", 224)):
        scene = json.loads(by_name[name])
        header = json.loads(scene["header"])
        data = gzip.decompress(base64.b64decode(scene["data"]))
        kind, offset, count, _, _ = header["meshes"][0]["index"]
        index = np.frombuffer(data, kind, count, offset)
        assert len(index) == 3 * triangles
        kind, offset, count, width, _ = header["meshes"][0]["attributes"]["position"]
        positions = np.frombuffer(data, kind, count, offset).reshape(-1, width) / 32767
        np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 1, atol=1e-4)
        assert index.max() < len(positions)
        colour = decode(base64.b64decode(scene["images"][0]), "colour")
        assert colour.shape == (64, 64, 3)
    half = np.frombuffer(
        gzip.decompress(base64.b64decode(json.loads(by_name["sky"])["data"])), np.float16
    )
    assert np.isfinite(half).all() and half.size == 64 * 128 * 4


def test_a_page_without_the_library_has_no_viewer(
    ball: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(three, "TEMPLATE", "resources/templates/none.zip")
    text = page(small_data(ball))
    assert not Page(text).open and "id='viewer'" not in text and "three-js'" not in text


def test_heavy_originals_are_reduced_or_left_out(
    ball: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preview, "MAX_TRIANGLES", 500)
    data = small_data(ball)
    reduced = data.previews["original"].reduced
    assert reduced is not None and 250 < reduced <= 500
    assert f"shown with {reduced} triangles" in page(data)
    data.previews["original"] = replace(data.previews["original"], data=bytes(4_000_000))
    text = page(data)
    assert "too large" in text and "data-name='original'" not in text


def test_reduced_meshes_keep_their_shape_and_do_not_crack() -> None:
    """Places on the seam of a ball's texture coordinates are one and the same on both sides."""
    mesh = make_asset(60, 120).meshes[0]
    (small,) = preview._reduce([mesh], 3000)
    assert 1000 < len(small.faces) <= 3000
    assert small.uvs is not None and small.normals is not None
    distance = np.linalg.norm(small.positions, axis=1)
    assert distance.min() > 0.97 and distance.max() <= 1.0001
    toward = small.positions / distance[:, None]
    assert (np.sum(small.normals * toward, axis=1) > 0.95).all()
    # a closed surface: each edge between places has two triangles, but at folds of the clustering
    _, place = np.unique(small.positions, axis=0, return_inverse=True)
    f = place.ravel()[small.faces]
    edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 1).mean() < 0.01


def test_verdicts_say_what_was_measured() -> None:
    def sizes(*shares: float) -> list[AtSize]:
        return [AtSize(384 >> k, s, 30.0, 0.1) for k, s in enumerate(shares)]

    say = describe_visibility
    assert say(sizes(0.01, 0.001)) == (
        "Differences are invisible at 384 pixels, the largest size measured."
    )
    assert say(sizes(0.2, 0.012, 0.01)) == (
        "Differences are invisible at 96 pixels; at 384, an eye that flips between the two notices "
        "20 % of the pixels."
    )
    assert say(sizes(0.2, 0.06, 0.04)).startswith("Differences are hardly visible at 96 pixels; at")
    assert say(sizes(0.04, 0.02)).startswith("Differences are hardly visible at 384 pixels: an eye")
    assert say(sizes(0.2, 0.0, 0.3)) == (  # what is seen when it is smaller is not invisible
        "An eye that flips between the two notices 20 % of the pixels at 384 pixels, and 30 % at 96."
    )
    assert say(sizes(0.2)) == (
        "An eye that flips between the two notices 20 % of the pixels at 384 pixels."
    )
    assert [percent(x) for x in (0, 0.00004, 0.0123, 0.0996, 1)] == [
        "0 %",
        "0.004 %",
        "1.2 %",
        "10 %",
        "100 %",
    ]
    assert [in_bytes(n) for n in (999, 1000, 12_345, 999_600, 6_718_200)] == [
        "999 bytes",
        "1.0 kB",
        "12 kB",
        "1.0 MB",
        "6.7 MB",
    ]


def test_differences_are_noticed_where_they_are() -> None:
    """Half of a grey square gets lighter: by far more than an eye notices, by far less, or so
    little by little that it vanishes when the picture is small."""
    image = np.zeros((1, 96, 96, 4), np.float32)
    image[:, 16:80, 16:80] = (0.2, 0.2, 0.2, 1.0)
    other = image.copy()
    other[:, 16:80, 16:48, :3] *= 1.5
    assert compare_images(image, other).noticed == pytest.approx(0.5, abs=0.12)
    other[:, 16:80, 16:48, :3] = image[:, 16:80, 16:48, :3] * 1.01
    assert compare_images(image, other).noticed == 0
    rows = image.copy()
    light = np.arange(96) // 2 % 2 == 0
    rows[:, light, :, :3] *= 1.6
    rows[:, ~light, :, :3] *= 0.4
    sizes = at_sizes(image, rows)
    assert [s.pixels for s in sizes] == [96, 48] and sizes[1].noticed < 0.1 < 0.3 < sizes[0].noticed
    np.testing.assert_allclose(halve(halve(rows))[0, 5:19, 5:19, 0], 0.2, rtol=1e-5)


def test_sizes_count_what_engines_draw_and_keep(tmp_path: Path) -> None:
    texture = Texture(np.zeros((8, 16, 3), np.uint8), "srgb")
    material = Material(base_color_texture=texture, emission_texture=texture)
    mesh = replace(make_asset(8, 16).meshes[0], material=material)
    (tmp_path / "a.glb").write_bytes(bytes(1234))
    sizes = sizes_of(Asset((mesh, mesh), "two"), [tmp_path / "a.glb", tmp_path / "gone.png"])
    assert (sizes.draw_calls, sizes.materials, len(sizes.maps)) == (2, 1, 1)
    assert (sizes.texture_bytes, sizes.file_bytes) == (8 * 16 * 4 * 4 // 3, 1234)
    both = ReportData(
        "", {}, {}, [], sizes={"original": sizes, "result": replace(sizes, triangles=9)}
    )
    assert (
        verdict(both) == f"{percent(9 / sizes.triangles)} of the triangles and 100 % of the bytes. "
    )


def test_the_view_is_upright_and_shows_most() -> None:
    """A wall that is painted on its back alone is looked at from behind."""
    points = support(make_asset().points())
    drawn = []

    def show(views):
        drawn.append(views)
        images = np.zeros((len(views), 16, 16, 4), np.float32)
        images[..., 3] = 1
        for k, eye in enumerate(views.eye):
            if eye[2] < 0 < eye[0]:
                images[k, ::2, :, :3] = 0.5
        return images

    view = hero_view(points, show)
    assert len(view) == 1 and view.eye[0][2] < 0 < view.eye[0][0]
    eye, down = view.eye[0], view.down[0]
    assert 0.1 < eye[1] / np.linalg.norm(eye) < 0.6 and down[1] < 0
    assert abs(view.right[0][1]) < 1e-3 * np.linalg.norm(view.right[0])
    same = hero_view(points, lambda v: np.zeros((len(v), 16, 16, 4), np.float32))
    assert same.eye[0][2] > 0  # nothing to choose by: the front


class Box:
    """A reference that is nothing but images."""

    def __init__(self, asset: Asset) -> None:
        self._inner = MeshReference(asset)
        self.bounds = self._inner.bounds

    def render(self, views: Views, resolution: int, samples: int = 16) -> np.ndarray:
        return self._inner.render(views, resolution, samples)


@pytest.mark.parametrize("known", [True, False])
def test_what_is_shown_of_assets_and_of_images_alone(ball: Asset, known: bool) -> None:
    low = make_asset(8, 16)
    sampler = views_around(ball.points(), 0)
    looks = Looks(views=2, resolution=96, samples=4, pictured=64)
    reference = MeshReference(ball) if known else Box(ball)
    columns = {"start": make_asset(4, 8), "result": low}
    shown = show(reference, ball if known else None, columns, low, sampler, looks)
    assert shown.metrics["result"].psnr > shown.metrics["start"].psnr
    assert [s.pixels for s in shown.by_size] == [96, 48]
    assert shown.by_size[0].noticed == shown.metrics["result"].noticed
    hero, worst = shown.views
    assert hero["reference"].shape == hero["wireframe"].shape == (64, 64, 3)
    assert worst["result"].shape == (96, 96, 3)
    assert set(shown.previews) == ({"original", "result"} if known else {"result"})
    assert ("lamp" in shown.captions[0]) and (("sky" in shown.captions[0]) == known)
    # as bright in the middle, where both show the ball
    middle = [hero[n][24:40, 24:40].mean() for n in ("reference", "result")]
    assert middle[0] == pytest.approx(middle[1], rel=0.1)
    text = page(ReportData("", {}, **vars(shown)))
    assert ("value='both'" in text) == known


def test_pictures_shrink_by_averages_and_stay_what_they_are() -> None:
    pixels = np.arange(6 * 10 * 3, dtype=np.uint8).reshape(6, 10, 3)
    small = shrink(pixels, 5)
    assert small.shape == (3, 5, 3)
    block = pixels[:2, :2].astype(float).mean(axis=(0, 1))
    np.testing.assert_allclose(small[0, 0], block, atol=0.51)
    assert shrink(pixels, 10) is pixels
    np.testing.assert_array_equal(decode(encode_for_page(pixels, None), "lossless"), pixels)
