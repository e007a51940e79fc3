"""Whatever a damaged file makes a reader raise becomes one line; faults of our own do not; names
are text."""

from __future__ import annotations

import base64
import json
import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from appearance_opt.asset import gltf_read, images, load, usd_guard
from appearance_opt.asset.door import reading
from appearance_opt.config import read_toml, simplify_options
from appearance_opt.errors import InputError, one_line
from appearance_opt.evaluate.report import ReportData, page


def triangle(**changes: object) -> dict:
    """A glTF file of one triangle, in itself."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(positions).decode()
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
        **changes,
    }


@pytest.mark.parametrize(
    "fault",
    [
        ZeroDivisionError("x"),
        KeyError("mesh"),
        RecursionError("deep"),
        struct.error("short"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"),
        RuntimeError("from a library"),
        np.linalg.LinAlgError("singular"),
    ],
)
def test_what_data_raises_becomes_one_line_that_names_file_and_place(fault: Exception) -> None:
    with pytest.raises(InputError) as caught, reading(Path("x.glb")):
        images.decode(_Raising(fault), "picture")  # type: ignore[arg-type]
    text = str(caught.value)
    assert text.startswith("x.glb: ") and "\n" not in text
    assert type(fault).__name__ in text and "images:" in text
    assert caught.value.__cause__ is fault


class _Raising:
    """Bytes whose first look raises."""

    def __init__(self, fault: Exception) -> None:
        self.fault = fault

    def __bool__(self) -> bool:
        raise self.fault


@pytest.mark.parametrize(
    "fault",
    [
        NameError("pixls"),
        AssertionError(),
        NotImplementedError(),
        ImportError("x"),
        AttributeError("module has no function of that name", obj=json),
    ],
)
def test_planted_bugs_stay_visible(
    fault: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise fault

    path = tmp_path / "x.gltf"
    path.write_text(json.dumps(triangle()))
    monkeypatch.setattr(gltf_read._Reader, "asset", broken)
    with pytest.raises(type(fault)) as caught:
        load(path)
    assert caught.value is fault


def test_control_characters_and_surrogates_are_shown_as_escapes() -> None:
    assert one_line("a\x1b[31m\tb\n\u202ec \ud800é") == "a\\x1b[31m b \\u202ec \\ud800é"
    assert str(InputError("x\x07: no")) == "x\\x07: no"
    text = str(InputError("begin " + "x" * 5000 + " end"))
    assert len(text) == 1000 and text.startswith("begin x") and text.endswith("x end")
    shown = page(ReportData("a\x1b<b>{{facts}}", {"k": "{{notes}}"}, {}, [], notes=["n\x1b"]))
    assert "\x1b" not in shown
    assert "a\\x1b&lt;b&gt;{{facts}}" in shown and "{{notes}}" in shown


def test_names_become_text(tmp_path: Path) -> None:
    document = triangle()
    document["nodes"][0]["name"] = 5
    document["extensionsUsed"] = ["\ud800\x1b"]
    path = tmp_path / "x.gltf"
    path.write_text(json.dumps(document))
    asset = load(path)
    assert asset.meshes[0].name == "5"
    assert any("\\ud800\\x1b" in note for note in asset.notes)


def test_an_asset_object_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.gltf"
    path.write_text(json.dumps(triangle(asset=[])))
    with pytest.raises(InputError, match="no 'asset' object"):
        load(path)


def test_job_files_nested_too_deep_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "job.toml"
    path.write_text("triangles = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(InputError, match="not a valid TOML file"):
        read_toml(path)


def test_the_name_of_a_picture_chooses_no_reader(tmp_path: Path) -> None:
    """OpenImageIO's "null" reader makes up pictures of any size from a name alone."""
    path = tmp_path / "t.null"
    path.write_bytes(b"no picture")
    with pytest.raises(InputError, match="not a readable image"):
        images.read(path)
    data = images.encode_png(np.full((2, 3, 3), 7, np.uint8))
    path.write_bytes(data)
    assert images.read(path).shape == (2, 3, 3)


LAYER = '#usda 1.0\n(\n    defaultPrim = "R"\n)\ndef Xform "R"\n{\n}\n'


def package(path: Path, compression: int = zipfile.ZIP_STORED) -> bytes:
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("a.usda", LAYER)
    return path.read_bytes()


def test_packages_with_compressed_or_overlapping_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.usdz"
    package(path, zipfile.ZIP_DEFLATED)
    with pytest.raises(InputError, match="is compressed; store it without"):
        usd_guard.check_usd(path.read_bytes(), path)
    data = package(path)
    (directory,) = struct.unpack_from("<I", data, len(data) - 6)
    entry, end = data[directory:-22], bytearray(data[-22:])
    struct.pack_into("<HHI", end, 8, 500, 500, 500 * len(entry))
    with pytest.raises(InputError, match="overlap"):
        usd_guard.check_usd(data[:directory] + entry * 500 + bytes(end), path)


@pytest.mark.skipif(os.name != "posix", reason="limits are POSIX's")
def test_the_guard_of_usd_stands_under_a_limit_of_memory(tmp_path: Path) -> None:
    """Schedulers of clusters set hard limits, which nobody may raise."""
    path = tmp_path / "x.usda"
    path.write_text(LAYER)
    code = (
        "import resource, sys; from pathlib import Path\n"
        "resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))\n"
        "from appearance_opt.asset.usd_guard import survives\n"
        "print(survives(Path(sys.argv[1])))"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert done.stdout == "True\n", done.stderr


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names are POSIX's")
def test_layers_that_never_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe.usda")
    path = tmp_path / "x.usda"
    path.write_text(LAYER.replace('"R"\n{', '"R" (\n    references = @./pipe.usda@</R>\n)\n{'))
    monkeypatch.setattr(usd_guard, "PATIENCE", 5.0)
    with pytest.raises(InputError, match="waits for ever"):
        load(path)


def test_pictures_whose_damage_is_no_text_are_refused(tmp_path: Path) -> None:
    """OpenImageIO quotes the file's bytes in what it says, as if they were UTF-8."""
    data = bytearray(images.encode_exr(np.zeros((4, 4, 3), np.float32)))
    at = data.index(b"channels\0chlist")
    data[at : at + 8] = b"\xff" * 8
    with pytest.raises(InputError, match=r"picture: (not a readable image|the image is damaged)"):
        images.decode(bytes(data), "picture")


def test_errors_quote_no_more_than_a_line_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "job.toml"
    path.write_text("a" * 5000 + " = 1")
    with pytest.raises(InputError) as caught:
        read_toml(path)
    assert len(str(caught.value)) < 500


def test_mistakes_in_usd_text_are_placed_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.usda"
    path.write_text(LAYER.replace("{\n}", "{\n    int[] a = [1, 2\n}"))
    with pytest.raises(InputError) as caught:
        load(path)
    assert "x.usda:8:1: parse error" in str(caught.value)
    assert "pxrInternal" not in str(caught.value)


@pytest.mark.parametrize("level", [1.9, True, "1.9", [2, 1.5], float("inf")])
def test_levels_of_tessellation_are_whole(level: object) -> None:
    with pytest.raises(InputError, match="--subdivision"):
        simplify_options(triangles=10, displacement=True, subdivision=level)
