"""Another program as a reference: views go to it as JSON lines, images come back as files.

The protocol (docs/black_boxes.md tells it to those who write such a program). Every message is one
line of JSON. The program is started once, and ends when its input does.

1. ``{"protocol": 1, "folder": "/tmp/..."}`` -> ``{"bounds": [[x, y, z], [x, y, z]], "light":
   "point" | "static"}``
2. ``{"resolution": N, "samples": K, "views": [{"id", "eye", "forward", "right", "down", "light",
   "intensity"}, ...]}`` -> a line for each view: ``{"id": 7, "file": "name"}``, a file in the
   folder, .exr (channels R, G, B, A) or .raw (float32, little-endian, rows of RGBA from the top);
   or ``{"id": 7, "error": "what went wrong"}``
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import weakref
from pathlib import Path, PurePath
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import images
from appearance_opt.errors import InputError, ReferenceRenderError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.views import Views

PROTOCOL = 1

STARTUP, TIMEOUT = 60.0, 120.0
"""Seconds that a program has for its first answer, and for each view."""

CLOSING = 2.0
"""Seconds that it has to end by itself when its input has ended, and again when it is asked to."""

LONGEST_LINE, QUOTED = 1 << 16, 120
"""Characters of an answer, and of what messages quote of one."""


class CommandReference:
    """A program that renders (see ``Reference``), in its own coordinates and unit of length.

    ``command``: what to run, as a list of words or as one line (no shell reads it). ``startup``,
    ``timeout``: seconds for its first answer, and for each view. ``static_light``: does its light
    stand still, whatever the views say? Use it in a ``with``, or call ``close``; the program ends
    with this process in any case. Raises InputError if it cannot be started or does not say what
    it is, ReferenceRenderError naming the view for whatever goes wrong later.
    """

    def __init__(
        self, command: str | Sequence[str], startup: float = STARTUP, timeout: float = TIMEOUT
    ) -> None:
        words = _words(command)
        self.name = shlex.join(words)
        if len(self.name) > QUOTED:
            self.name = self.name[:QUOTED] + "..."
        self._timeout, self._asked = timeout, 0
        self._folder = Path(tempfile.mkdtemp(prefix="appearance-opt-"))
        self._said = self._folder / "stderr.txt"
        try:
            with self._said.open("wb") as said:
                self._process = subprocess.Popen(
                    words,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=said,
                    start_new_session=True,  # a Ctrl-C in the terminal is for us alone
                )
        except (OSError, ValueError) as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{self.name}: cannot be started: {reason}") from error
        self._answers: queue.Queue[bytes | None] = queue.Queue()
        assert self._process.stdout is not None
        listener = threading.Thread(
            target=_listen, args=(self._process.stdout, self._answers), daemon=True
        )
        listener.start()
        self._end = weakref.finalize(self, _end, self._process, listener, self._folder)
        try:
            self.bounds, self.static_light = self._introduce(startup)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> CommandReference:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the program and remove its files."""
        self._end()

    def _introduce(self, seconds: float) -> tuple[NDArray[np.float64], bool]:
        """(bounds, does its light stand still?)"""
        what = "when it was started"
        try:
            self._send({"protocol": PROTOCOL, "folder": str(self._folder)}, what)
            answer = self._answer(seconds, what)
        except ReferenceRenderError as error:
            raise InputError(str(error)) from error
        try:
            bounds = np.array(answer["bounds"], np.float64)
            if bounds.shape != (2, 3) or not np.isfinite(bounds).all():
                raise ValueError
        except (KeyError, TypeError, ValueError):
            raise InputError(
                f"{self.name}: its first line must hold bounds, two points of three numbers, not "
                f"{_quote(json.dumps(answer).encode())}"
            ) from None
        light = answer.get("light", "point")
        if light not in ("point", "static"):
            raise InputError(f"{self.name}: light must be point or static, not {light!r}")
        return bounds, light == "static"

    def render(self, views: Views, resolution: int, samples: int = 16) -> NDArray[np.float32]:
        """See ``Reference``."""
        if not self._end.alive:
            raise ReferenceRenderError(f"{self.name}: was closed")
        first, count = self._asked, len(views)
        self._asked += count
        request = {
            "resolution": resolution,
            "samples": samples,
            "views": [{"id": first + k, **_described(views, k)} for k in range(count)],
        }
        self._send(request, f"view {first}")
        out = np.empty((count, resolution, resolution, 4), np.float32)
        waiting = set(range(first, first + count))
        while waiting:
            number, image = self._image(waiting, resolution)
            out[number - first] = image
            waiting.remove(number)
        return out

    def _image(self, waiting: set[int], resolution: int) -> tuple[int, NDArray[np.float32]]:
        """(number, pixels) of the next view that is answered."""
        what = f"view {min(waiting)}"
        answer = self._answer(self._timeout, what)
        number = answer.get("id")
        if not isinstance(number, int) or number not in waiting:
            raise self._wrong(what, f"answered for a view that was not asked for, {number!r}")
        what = f"view {number}"
        if "error" in answer:
            raise self._wrong(what, f"says: {answer['error']}")
        name = answer.get("file")
        if not isinstance(name, str) or PurePath(name).name != name:
            raise self._wrong(what, f"must name a file in its folder, not {name!r}")
        path = self._folder / name
        if path.is_symlink() or not path.is_file():
            raise self._wrong(what, f"wrote no file {name}")
        try:
            image = self._read(path, resolution, what)
        finally:
            path.unlink(missing_ok=True)
        bad = int((~np.isfinite(image) | (image < 0)).any(axis=-1).sum())
        if bad:
            raise self._wrong(what, f"wrote {bad} pixels that are NaN, infinite or negative")
        if image[..., 3].max() > 1.001:
            raise self._wrong(what, "wrote a coverage above 1")
        return number, image

    def _read(self, path: Path, resolution: int, what: str) -> NDArray[np.float32]:
        wanted = (resolution, resolution, 4)
        if path.suffix == ".raw":
            size = path.stat().st_size
            if size != 4 * int(np.prod(wanted)):
                raise self._wrong(
                    what, f"wrote {size} bytes, not {resolution} x {resolution} x 4 floats"
                )
            return np.fromfile(path, "<f4").reshape(wanted)
        if path.suffix != ".exr":
            raise self._wrong(what, f"wrote {path.name}; only .exr and .raw are read")
        try:
            pixels = images.read(path)
        except InputError as error:
            raise self._wrong(what, f"wrote a file that cannot be read: {error}") from error
        if pixels.shape != wanted or pixels.dtype.kind != "f":
            shape = " x ".join(map(str, pixels.shape))
            raise self._wrong(
                what, f"wrote {shape} numbers, not {resolution} x {resolution} x 4 floats"
            )
        return pixels.astype(np.float32)

    def _send(self, message: dict[str, Any], what: str) -> None:
        line = json.dumps(message).encode() + b"\n"
        stdin = self._process.stdin
        assert stdin is not None
        # a program that does not read must not stop us
        writer = threading.Thread(target=_write, args=(stdin, line), daemon=True)
        writer.start()
        writer.join(self._timeout)
        if writer.is_alive():
            raise self._wrong(what, "does not read its input")

    def _answer(self, seconds: float, what: str) -> dict[str, Any]:
        try:
            line = self._answers.get(timeout=seconds)
        except queue.Empty:
            raise self._wrong(
                what, f"gave no answer within {seconds:g} s (--timeout allows more)"
            ) from None
        if line is None:
            self._answers.put(None)  # it stays ended
            raise self._wrong(what, self._how_it_ended())
        try:
            answer = json.loads(line)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict):
            raise self._wrong(
                what, f"answered {_quote(line)}, which is no JSON object; stdout is for answers"
            )
        return answer

    def _how_it_ended(self) -> str:
        try:
            code = self._process.wait(CLOSING)
        except subprocess.TimeoutExpired:
            return "closed its output"
        lines = self._said.read_bytes()[-4096:].decode("utf-8", "replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return f"{how}, saying: {last}" if last else how

    def _wrong(self, what: str, how: str) -> ReferenceRenderError:
        return ReferenceRenderError(f"{self.name}: {what}: the program {how}")


def _words(command: str | Sequence[str]) -> list[str]:
    try:
        words = shlex.split(command) if isinstance(command, str) else list(command)
    except ValueError as error:
        raise InputError(f"{command}: is no command: {error}") from error
    if not words:
        raise InputError("the command is empty")
    return words


def _described(views: Views, k: int) -> dict[str, Any]:
    rows = {
        name: [float(x) for x in getattr(views, name)[k]]
        for name in ("eye", "forward", "right", "down", "light")
    }
    return {**rows, "intensity": float(views.intensity[k])}


def _quote(line: bytes) -> str:
    text = line[:QUOTED].decode("utf-8", "replace").strip()
    return f"'{text}...'" if len(line) > QUOTED else f"'{text}'"


def _listen(stdout: IO[bytes], answers: queue.Queue[bytes | None]) -> None:
    with stdout, contextlib.suppress(OSError, ValueError):
        while line := stdout.readline(LONGEST_LINE):
            answers.put(line)
    answers.put(None)


def _write(stdin: IO[bytes], line: bytes) -> None:
    # that it has ended is found when it does not answer
    with contextlib.suppress(OSError, ValueError):
        stdin.write(line)
        stdin.flush()


def _end(process: subprocess.Popen[bytes], listener: threading.Thread, folder: Path) -> None:
    """End a program by ever clearer signs, with all that it has started, and remove its folder."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):
        process.stdin.close()
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            process.wait(CLOSING)
            break
        except subprocess.TimeoutExpired:
            _signal(process, number)
    process.wait()
    listener.join(CLOSING)
    shutil.rmtree(folder, ignore_errors=True)


def _signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
