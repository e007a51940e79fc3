"""Other programs as references: what goes over the pipe, and everything that can go wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
import pytest

from appearance_opt import backend
from appearance_opt.asset.images import encode_exr
from appearance_opt.errors import InputError, ReferenceRenderError
from appearance_opt.reference import command
from appearance_opt.reference.command import CommandReference
from appearance_opt.reference.plugins import MINIMUM_LLVM
from appearance_opt.views import look_at

if TYPE_CHECKING:
    from appearance_opt.views import Views

HANGS = 600
"""Seconds after which a program counts as hanging, however busy the machine."""

RAYCAST = Path(__file__).parents[1] / "scenes" / "raycast.py"

PROGRAM = """
import json, os, pathlib, struct, sys, time
folder = pathlib.Path(json.loads(sys.stdin.readline())["folder"])
print(json.dumps({"bounds": [[-1, -1, -1], [1, 1, 1]], "light": "static"}), flush=True)
for line in sys.stdin:
    request = json.loads(line)
    n = request["resolution"]
    for view in reversed(request["views"]):
        number, name = view["id"], str(view["id"]) + ".raw"
        values = [view["eye"][2], 0.5, 0.25, 1.0] * (n * n)
        answer = {"id": number, "file": name}
        BODY
        if values is not None:
            (folder / name).write_bytes(struct.pack("<%df" % len(values), *values))
        print(json.dumps(answer), flush=True)
"""


def program(folder: Path, body: str = "pass", **limits: float) -> CommandReference:
    path = folder / "program.py"
    path.write_text(PROGRAM.replace("BODY", textwrap.indent(body, 8 * " ").lstrip()))
    return CommandReference([sys.executable, "-S", str(path)], **limits)


def views(count: int = 2) -> Views:
    eyes = np.array([[0.0, 0.0, 3.0 + k] for k in range(count)])
    return look_at(eyes, np.zeros(3), 30.0, eyes, 9.0)


def test_images_come_back_to_their_views(tmp_path: Path) -> None:
    with program(tmp_path) as reference:
        assert reference.static_light
        np.testing.assert_array_equal(reference.bounds, [[-1] * 3, [1] * 3])
        for _ in range(2):  # answered in reverse
            images = reference.render(views(3), 4)
            assert images.shape == (3, 4, 4, 4) and images.dtype == np.float32
            np.testing.assert_allclose(images[:, 0, 0, 0], [3, 4, 5])
            np.testing.assert_allclose(
                images[..., 1:], np.broadcast_to([0.5, 0.25, 1], (3, 4, 4, 3))
            )
        process, folder = reference._process, reference._folder
        assert not list(folder.glob("*.raw"))
    assert process.poll() == 0 and not folder.exists()  # its input ended, so did it
    with pytest.raises(ReferenceRenderError, match="was closed"):
        reference.render(views(), 4)


def test_exr_files_are_read(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((4, 4, 4)).astype(np.float32)
    (tmp_path / "made.exr").write_bytes(encode_exr(pixels))
    body = f"""values, answer["file"] = None, "a.exr"
(folder / "a.exr").write_bytes(pathlib.Path({str(tmp_path / "made.exr")!r}).read_bytes())"""
    with program(tmp_path, body) as reference:
        np.testing.assert_allclose(reference.render(views(1), 4)[0], pixels, atol=1e-6)
        with pytest.raises(ReferenceRenderError, match=r"view 1.*4 x 4 x 4 numbers, not 8 x 8 x 4"):
            reference.render(views(1), 8)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("sys.exit('no memory')", "view 0: the program ended with exit code 1, saying: no memory"),
        ("os.kill(os.getpid(), 9)", "view 0: the program was killed by signal 9"),
        ("values[5] = float('nan')", "view 1: the program wrote 1 pixels that are NaN"),
        ("values[5] = -1.0", "view 1.*negative"),
        ("values[3] = 2.0", "view 1.*coverage above 1"),
        ("values.pop()", "view 1.*252 bytes, not 4 x 4 x 4 floats"),
        ("print('Loading...', flush=True)", "view 0.*'Loading...', which is no JSON object"),
        ("print('[1]', flush=True)", "view 0.*which is no JSON object"),
        ("answer['id'] = 77", "view 0.*not asked for, 77"),
        ("answer['file'] = '../x.raw'", "view 1.*file in its folder, not '../x.raw'"),
        ("answer['file'] = '/etc/passwd'", "view 1.*file in its folder"),
        ("answer['file'] = 'x.png'; (folder / 'x.png').touch()", "only .exr and .raw are read"),
        ("values, answer['file'] = None, 'no.exr'", "view 1.*wrote no file no.exr"),
        ("answer['file'] = 'x.exr'; (folder / 'x.exr').touch()", "cannot be read"),
        ("answer = {'id': number, 'error': 'out of film'}", "view 1.*says: out of film"),
    ],
)
def test_what_goes_wrong_names_the_view(tmp_path: Path, body: str, message: str) -> None:
    with program(tmp_path, body) as reference, pytest.raises(ReferenceRenderError, match=message):
        reference.render(views(), 4)


def test_a_program_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "CLOSING", 0.2)
    body = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"
    with program(tmp_path, body, timeout=0.3) as reference:
        with pytest.raises(ReferenceRenderError, match=r"view 0.*no answer within 0.3 s"):
            reference.render(views(1), 4)
        process = reference._process
    assert process.poll() is not None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("no-such-program --at-all", "cannot be started: No such file"),
        ("", "is empty"),
        ("'open", "is no command"),
        ([sys.executable, "-c", "print('hello')"], "'hello', which is no JSON object"),
        ([sys.executable, "-c", "print('{}')"], "must hold bounds"),
        ([sys.executable, "-c", "print('{\"bounds\": [[0, 0], [1, 1]]}')"], "must hold bounds"),
        ([sys.executable, "-c", "raise SystemExit(3)"], "ended with exit code 3"),
        ([sys.executable, "-c", "import time; time.sleep(600)"], "no answer within 0.5 s"),
    ],
)
def test_what_is_no_such_program_is_refused(
    words: str | list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "CLOSING", 0.2)
    with pytest.raises(InputError, match=message):
        CommandReference(words, startup=30.0 if "sleep" not in str(words) else 0.5)


def test_the_ray_caster_of_the_docs_draws_its_balls() -> None:
    """The blue ball's middle, seen and lit from the front: radiance = albedo / pi * I / d^2."""
    eye = np.array([[0.5, 0.2, 10.1]])
    view = look_at(eye, np.array([0.5, 0.2, 0.1]), 20.0, eye, 9.5**2 * np.pi)
    with CommandReference([sys.executable, str(RAYCAST)]) as reference:
        image = reference.render(view, 33)[0]
        np.testing.assert_allclose(image[16, 16], [0.1, 0.5, 0.8, 1], rtol=0.01)
        assert reference.bounds[0] == pytest.approx([-1.2, -0.6, -0.6])
        assert 0 < image[..., 3].mean() < 1 and not reference.static_light


def test_mitsuba_in_another_process(tmp_path: Path, variant: str) -> None:
    """A white ball under an even sky of radiance 0.5, whose reflectance is Mitsuba's default."""
    if variant == backend.CPU and dr.detail.llvm_version()[0] < MINIMUM_LLVM:
        pytest.skip("Mitsuba's plugins need a newer LLVM")
    scene = tmp_path / "ball.xml"
    scene.write_text(
        '<scene version="3.0.0"><shape type="sphere"/><emitter type="constant">'
        '<rgb name="radiance" value="0.5"/></emitter></scene>'
    )
    eye = np.array([[0.0, 0.0, 8.0]])
    view = look_at(eye, np.zeros(3), 20.0, eye, 1.0)
    words = [sys.executable, str(RAYCAST.with_name("mitsuba_program.py")), str(scene), "scalar"]
    with CommandReference(words) as reference:
        assert reference.static_light
        np.testing.assert_allclose(reference.bounds, [[-1] * 3, [1] * 3], atol=1e-6)
        image = reference.render(view, 12)[0]
    np.testing.assert_allclose(image[5:7, 5:7].mean(axis=(0, 1)), [0.25, 0.25, 0.25, 1], rtol=0.05)
    assert image[0, 0].max() == 0


HOLDER = """
import sys, time
from appearance_opt.reference.command import CommandReference
reference = CommandReference(sys.argv[1:])
print(reference._process.pid, reference._folder, flush=True)
time.sleep(600)
"""


def test_a_program_ends_when_its_user_does(tmp_path: Path) -> None:
    """A Ctrl-C ends the job; the program, which it does not reach, ends with it."""
    words = [sys.executable, "-c", HOLDER, sys.executable, str(RAYCAST)]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=RAYCAST.parents[1]
    ) as holder:
        assert holder.stdout is not None
        process, folder = holder.stdout.readline().split()
        assert Path(folder).is_dir()
        holder.send_signal(signal.SIGINT)
        holder.communicate(timeout=HANGS)
    assert not Path(folder).exists()
    with pytest.raises(ProcessLookupError):
        os.kill(int(process), 0)
