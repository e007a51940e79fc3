"""Checkpoints: what is kept of a job, which job and which start it belongs to, and folders that
hold other things."""

from __future__ import annotations

import contextlib
import zipfile
from dataclasses import dataclass, field, fields, make_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import appearance_opt
from appearance_opt.asset.types import Asset, Material, Mesh, Texture
from appearance_opt.config import SimplifyOptions, simplify_options
from appearance_opt.digest import digest
from appearance_opt.errors import InputError
from appearance_opt.jobs.lifecycle import fingerprint
from appearance_opt.latent.mesh import LatentMesh
from appearance_opt.optimize import archive
from appearance_opt.optimize.checkpoint import Checkpointer
from appearance_opt.stages.start import Start


@dataclass
class Inner:
    array: np.ndarray
    number: float = 0.5


@dataclass
class Outer:
    inner: Inner
    parts: dict = field(default_factory=dict)
    levels: tuple = (1, 2)
    nothing: None = None


def outer() -> Outer:
    return Outer(
        Inner(np.arange(6.0).reshape(2, 3), float("-inf")),
        {"a": np.ones(3, np.uint8), "b": 0.1},
        (1, (2, 3)),
    )


def same(a: object, b: object) -> bool:
    return digest(a) == digest(b)


def test_archives_give_back_every_field(tmp_path: Path) -> None:
    archive.write(tmp_path / "x", "job", outer())
    found = archive.read(tmp_path / "x", "job", (Outer, Inner))
    assert same(found, outer()) and found.inner.number == -np.inf and found.levels == (1, (2, 3))
    assert [p.name for p in tmp_path.iterdir()] == ["x"]
    with pytest.raises(InputError, match="another input"):
        archive.read(tmp_path / "x", "other", (Outer, Inner))
    with pytest.raises(archive.DamagedError):
        archive.read(tmp_path / "x", "job", (Outer,))
    more = make_dataclass("Inner", [f.name for f in fields(Inner)] + ["new"])
    with pytest.raises(archive.DamagedError, match="other fields"):
        archive.read(tmp_path / "x", "job", (Outer, more))
    with pytest.raises(TypeError, match="value/a: a object cannot be kept"):
        archive.write(tmp_path / "y", "job", {"a": object()})
    assert not (tmp_path / "y").exists()


def test_damaged_archives_are_refused_whatever_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "x"
    archive.write(path, "job", outer())
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for k in range(300):
        data = bytearray(whole)
        if k % 3 == 0:
            del data[rng.integers(len(data)) :]
        else:
            for at in rng.integers(0, len(data), 1 + k % 7):
                data[at] = rng.integers(256)
        path.write_bytes(data)
        # some bytes mean nothing, and one of the fingerprint makes it another job's
        with contextlib.suppress(archive.DamagedError, InputError):
            archive.read(path, "job", (Outer, Inner))
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(archive.DamagedError):
        archive.read(path, "job", (Outer, Inner))


def test_archives_allocate_no_more_than_they_hold(tmp_path: Path) -> None:
    archive.write(tmp_path / "x", "job", {"a": np.zeros(4, np.float32)})
    with zipfile.ZipFile(tmp_path / "x") as packed:
        parts = {name: packed.read(name) for name in packed.namelist()}
    huge = parts["value/a.npy"].replace(b"(4,), }         ", b"(99999999999,), }")
    assert huge != parts["value/a.npy"]
    for kind, content in ((zipfile.ZIP_STORED, huge), (zipfile.ZIP_DEFLATED, parts["value/a.npy"])):
        with zipfile.ZipFile(tmp_path / "x", "w", kind) as packed:
            packed.writestr("archive.json", parts["archive.json"], zipfile.ZIP_STORED)
            packed.writestr("value/a.npy", content)
        with pytest.raises(archive.DamagedError, match=r"another size|compressed"):
            archive.read(tmp_path / "x", "job", ())


def varied(value: object) -> object:
    """Something else of the same kind."""
    if isinstance(value, np.ndarray):
        return value + np.asarray(1, value.dtype)
    if isinstance(value, (str, tuple)):
        return value + type(value)("x")
    return {"x": value}


def test_every_field_counts_in_a_hash(ball: Asset) -> None:
    """Of assets, meshes, materials, textures and options, those that are added later included."""
    mesh = ball.meshes[0]
    texture = mesh.material.base_color_texture
    assert texture is not None
    for thing in (ball, mesh, mesh.material, texture, simplify_options(triangles=5)):
        for f in fields(thing):
            other = replace(thing)
            object.__setattr__(other, f.name, varied(getattr(thing, f.name)))
            assert digest(other) != digest(thing), f.name
    assert digest(Texture(texture.pixels.copy())) == digest(Texture(texture.pixels))
    assert (
        digest(np.zeros((2, 3))) != digest(np.zeros((3, 2))) != digest(np.zeros((3, 2), np.float32))
    )
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 2, "b": 1})
    with pytest.raises(TypeError, match="a object has no hash"):
        digest([object()])


def test_a_job_is_known_by_what_was_read_not_by_where_it_lay(ball: Asset) -> None:
    options = simplify_options(triangles=5)
    moved = replace(ball, files=(Path("/elsewhere"),), notes=("said",))
    assert fingerprint(options, moved, None) == fingerprint(options, ball, None)
    for other in (
        replace(ball, meshes=(replace(ball.meshes[0], material=Material("painted")),)),
        replace(ball, meshes=(replace(ball.meshes[0], name="other"),)),
    ):
        assert fingerprint(options, other, None) != fingerprint(options, ball, None)
    assert len({fingerprint(options, ball, first) for first in (None, ball, moved)}) == 2


def options(**values: object) -> SimplifyOptions:
    base = {
        "triangles": 100,
        "texture_size": 32,
        "resolution": 32,
        "pool": 4,
        "views": 2,
        "steps": 2,
        "budget": None,
    }
    return simplify_options(**{**base, **values})


def test_a_new_run_leaves_nothing_of_the_old_one(ball: Asset, tmp_path: Path) -> None:
    appearance_opt.simplify(ball, None, options(), checkpoint=tmp_path)
    (tmp_path / ".fit-abc.tmp").write_bytes(b"half a state")
    assert {p.name for p in tmp_path.iterdir()} == {"fit.npz", "start.npz", ".fit-abc.tmp"}
    Checkpointer(tmp_path, "the same job", resume=True)
    assert {p.name for p in tmp_path.iterdir()} == {"fit.npz", "start.npz"}
    Checkpointer(tmp_path, "another job", resume=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("resume", [False, True])
def test_folders_with_other_files_are_refused(ball: Asset, tmp_path: Path, resume: bool) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds 'notes\.txt', which is no checkpoint"):
        appearance_opt.simplify(ball, None, options(), checkpoint=tmp_path, resume=resume)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_files_of_others_under_our_names_are_not_removed(tmp_path: Path) -> None:
    np.savez(tmp_path / "fit.npz", mine=np.ones(3))
    with pytest.raises(InputError, match=r"fit\.npz: is no checkpoint"):
        Checkpointer(tmp_path, "job", resume=False)
    assert np.load(tmp_path / "fit.npz")["mine"].sum() == 3


def test_all_of_a_start_is_kept(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def mesh() -> LatentMesh:
        return LatentMesh(*(rng.random((3, 3)) for _ in fields(LatentMesh)))

    maps, known = {"red": rng.random((2, 2)), "blue": 0.5}, np.ones((2, 2), bool)
    start = Start(mesh(), maps, True, known, (0, 2), mesh(), True, mesh(), ("clustered first",))
    assert all(getattr(start, f.name) is not f.default for f in fields(Start)), (
        "give each field a value of its own"
    )
    first, _ = Checkpointer(tmp_path, "job", resume=False).start(
        lambda: (start, False), Start, LatentMesh
    )
    second, _ = Checkpointer(tmp_path, "job", resume=True).start(
        lambda: (None, False), Start, LatentMesh
    )
    assert same(first, start) and same(second, start)


def test_a_checkpoint_that_finds_no_room_does_not_end_the_fit(
    ball: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write, tries = archive.write, []

    def full(path: Path, *rest: object) -> None:
        if path.name == "fit.npz":
            tries.append(path)
            raise OSError(28, "No space left on device", str(path))
        write(path, *rest)

    monkeypatch.setattr(archive, "write", full)
    monkeypatch.setattr("appearance_opt.jobs.simplify.CHECKPOINT_SECONDS", 0.0)
    result = appearance_opt.simplify(ball, None, options(), checkpoint=tmp_path / "state")
    assert result.fit.steps == 2 and len(tries) == 3
    assert [
        r.getMessage().split(": ")[1] for r in caplog.records if "fit.npz" in r.getMessage()
    ] == ["cannot be written (No space left on device); the fit goes on without"]


def test_meshes_hash_alike_whether_shared_or_copied() -> None:
    p, f = np.zeros((3, 3), np.float32), np.zeros((1, 3), np.int32)
    material = Material()
    shared = Asset((Mesh(p, f, material=material), Mesh(p, f, material=material)))
    copied = Asset((Mesh(p, f, material=material), Mesh(p.copy(), f, material=Material())))
    assert same(shared, copied)
