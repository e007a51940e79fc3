"""Shared fixtures. Tests run on the CPU, or on a GPU with ``pytest --device cuda``."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import drjit as dr
import hypothesis
import numpy as np
import pytest

from appearance_opt import backend
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from tests import looks
from tests.inputs import watch_jobs

# what a shell starts in the background ignores interrupts, and so does all that it starts: tests
# send some
signal.signal(signal.SIGINT, signal.default_int_handler)

# the same examples everywhere, however long they take on a busy machine
hypothesis.settings.register_profile(
    "anywhere",
    derandomize=True,
    deadline=None,
    suppress_health_check=[
        hypothesis.HealthCheck.too_slow,
        hypothesis.HealthCheck.function_scoped_fixture,
    ],
)
hypothesis.settings.load_profile("anywhere")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device", default="cpu", choices=("cpu", "cuda"), help="what Dr.Jit computes on"
    )


@pytest.fixture(scope="session", autouse=True)
def variant(request: pytest.FixtureRequest) -> str:
    """All tests share one variant."""
    return backend.select(request.config.getoption("--device")).variant


@pytest.fixture(scope="session", autouse=True)
def small_looks(variant: str) -> Iterator[None]:
    """Jobs look at few and small views; see ``tests.looks``."""
    before = looks.make_small()
    yield
    looks.restore(before)


@pytest.fixture
def one_thread(variant: str) -> Iterator[float]:
    """On the CPU one thread alone computes, so that sums come in one order and equal fits end bit
    by bit equal. Hands out how far they may end apart: on a GPU, threads add up gradients in any
    order, and Adam makes a whole step of the sign of a vanishing one."""
    before = dr.thread_count()
    if variant == backend.CPU:
        dr.set_thread_count(1)
    yield 0.0 if variant == backend.CPU else 2e-2
    dr.set_thread_count(before)


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """No test leaves its handlers of signals to the next: the command line ignores interrupts once
    all is done, and so would all programs that are started later."""
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def inputs_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """No job of any test changes its inputs."""
    watch_jobs(monkeypatch)


@pytest.fixture(scope="session")
def assets_dir() -> Path:
    """Real models, where the checkout has them beside it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "assets"
    if not folder.is_dir():
        pytest.skip("the folder ../shared/assets is not there")
    return folder


def grid_sphere(
    rows: int, columns: int, radius: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """UV sphere with a seam: positions, faces, uvs (glTF convention, outward winding)."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    polar, azimuth = v * np.pi, u * 2 * np.pi
    p = np.stack(
        [np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], axis=-1
    )
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    a = i * (columns + 1) + j
    b, c, d = a + columns + 1, a + columns + 2, a + 1
    faces = np.concatenate([np.stack([a, b, c], 1)[i < rows - 1], np.stack([a, c, d], 1)[i > 0]])
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    return (
        (p.reshape(-1, 3) * radius).astype(np.float32),
        faces.astype(np.int32),
        uvs.astype(np.float32),
    )


def make_asset(rows: int = 24, columns: int = 48, size: int = 64, seed: int = 0) -> Asset:
    """A sphere with a smooth random colour texture, roughness and metalness."""
    positions, faces, uvs = grid_sphere(rows, columns)
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 2 * np.pi, size, endpoint=False)
    wave = 0.5 + 0.35 * np.sin(2 * x)[None, :] * np.cos(3 * x / 2)[:, None]
    color = np.stack([wave, 1 - wave, 0.3 + 0.4 * rng.random() * np.ones_like(wave)], axis=-1)
    orm = np.stack([np.ones_like(wave), 0.3 + 0.4 * wave, 0.5 * (wave > 0.5)], axis=-1)
    to8 = lambda v: (np.clip(v, 0, 1) * 255 + 0.5).astype(np.uint8)  # noqa: E731
    material = Material(
        "painted",
        roughness=1.0,
        metalness=1.0,
        base_color_texture=Texture(to8(color), "srgb"),
        orm_texture=Texture(to8(orm), "linear"),
    )
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    return Asset((Mesh(positions, faces, normals, uvs, material=material, name="ball"),), "ball")


@pytest.fixture(scope="session")
def ball() -> Asset:
    """A textured sphere of 2,208 triangles."""
    return make_asset()
