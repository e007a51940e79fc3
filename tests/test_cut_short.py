"""Files that end too early are refused, even where their readers would fill in what is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from appearance_opt.asset import images, load
from appearance_opt.errors import InputError


@pytest.fixture(scope="module", params=["plain", "progressive", "restarts"])
def jpeg(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("jpeg") / "x.jpg"
    spec = oiio.ImageSpec(48, 32, 3, oiio.UINT8)
    if request.param == "progressive":
        spec.attribute("jpeg:progressive", 1)
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(
        np.random.default_rng(0).integers(0, 256, (32, 48, 3), np.uint8).astype(np.uint8)
    )
    assert out.close()
    data = path.read_bytes()
    # an application segment that holds what looks like an end, as thumbnails do
    return (
        data[:2] + b"\xff\xe3\x00\x06\xff\xd9\xff\xd9" + data[2:]
        if request.param == "restarts"
        else data
    )


def test_jpeg_files_that_are_cut_short_are_refused(jpeg: bytes) -> None:
    assert images.decode(jpeg, "x").shape == (32, 48, 3)
    assert images.decode(jpeg + b"what cameras append", "x").shape == (32, 48, 3)
    for size in (*range(2, 40), *range(40, len(jpeg), 97), len(jpeg) - 2, len(jpeg) - 1):
        with pytest.raises(InputError, match="cut short"):
            images.decode(jpeg[:size], "x")


PLY = """ply
format ascii 1.0
comment a square and a property after the list
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
property uchar part
end_header
0 0 0
1 0 0
1 1 0
0 1 0
3 0 1 2 0
3 0 2 3 1
"""


def test_ply_files_in_text_that_are_cut_short_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    for text in (PLY, PLY.rstrip(), PLY.replace("\n", "\r\n"), PLY + "\n\n"):
        path.write_bytes(text.encode())
        assert load(path).triangle_count == 2
    lines = PLY.splitlines(keepends=True)
    for cut in ("".join(lines[:-1]), "".join(lines[:-2]), "".join(lines[:-4]), PLY[:-3], PLY[:-6]):
        path.write_text(cut)
        with pytest.raises(InputError, match=r"x\.ply: .*cut short"):
            load(path)
