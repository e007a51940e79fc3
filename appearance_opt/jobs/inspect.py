"""What is in a file: for an artist who wants to know before a long run."""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import load, sides
from appearance_opt.asset.alpha import (
    FITTED,
    KEPT,
    UNLIT,
    Share,
    count_kinds,
    kept_apart,
    kind_of,
    separate_opaque,
)
from appearance_opt.asset.types import Contents, Texture
from appearance_opt.asset.validate import Validation, repair_and_count
from appearance_opt.config import InspectOptions, resolve_options
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from appearance_opt.asset.types import Asset, Material, Mesh

LISTED = 12
"""Materials that are told one by one, those of the most triangles; names of anything else."""

COLUMNS = 80

MAPS = {
    "base_color_texture": "base colour",
    "orm_texture": "roughness/metalness",
    "normal_texture": "normal",
    "emission_texture": "emission",
    "transmission_texture": "transmission",
    "thickness_texture": "thickness",
}
"""Textures of a material, and what they are called."""


@dataclass(frozen=True)
class MapFacts:
    """A texture in its place: pixels, numbers per pixel and bits of each, "srgb" or "linear"."""

    map: str
    width: int
    height: int
    channels: int
    bits: int
    color_space: str


@dataclass(frozen=True)
class MaterialFacts:
    """``seen``: opaque, mask, blend or transmission, and if it is unlit; ``simplify``: what it does
    with the meshes that wear it."""

    name: str
    meshes: int
    triangles: int
    seen: str
    double_sided: bool
    simplify: str
    maps: tuple[MapFacts, ...]


@dataclass(frozen=True)
class ClipFacts:
    """A clip: seconds, and different times at which it has keys."""

    name: str
    seconds: float
    keys: int


@dataclass(frozen=True)
class RigFacts:
    """``joints`` that move vertices; ``influences``: the most of a vertex, and those that vertices
    have in the mean; ``rigid_meshes``: that move without a skin; ``rate``: frames per second;
    ``fault``: why nothing of this can be used, or None."""

    joints: int = 0
    influences: int = 0
    mean_influences: float = 0.0
    rigid_meshes: int = 0
    rate: float = 0.0
    animations: tuple[ClipFacts, ...] = ()
    fault: str | None = None

    def lines(self) -> list[str]:
        """The same for a terminal."""
        if self.fault is not None:
            return _wrap(f"{'rig':12}", f"cannot be used: {self.fault}")
        out = _wrap(
            f"{'rig':12}",
            f"{_some(self.joints, 'joint')}, at most {_some(self.influences, 'influence')} per "
            f"vertex ({self.mean_influences:.3g} in the mean), "
            f"{_some(self.rigid_meshes, 'rigid mesh', 'rigid meshes')}, "
            f"{self.rate:g} frames per second",
        )
        for clip in self.animations[:LISTED]:
            out.append(f"  {clip.name:24}{clip.seconds:.4g} s, {_some(clip.keys, 'key')}")
        if len(self.animations) > LISTED:
            out.append(f"  ... and {len(self.animations) - LISTED:,} clips more")
        return out


@dataclass(frozen=True)
class Inspection:
    """``size``: extent along x, y, z in metres; ``origin``: see ``Asset``; ``file_bytes``: of the
    ``files`` that the asset is made of; ``single_sided``: triangles that are fitted and seen from
    one side, and ``backs_in_sight`` those among them whose backs may come into sight (see
    ``asset.sides``); ``texture_bytes``: of their pixels as they are stored here, uncompressed,
    without mip levels; ``rig``: of what is animated, else None; ``parts``: names of the nodes that
    have meshes; ``copyright``: the line of its owners."""

    name: str
    files: int
    file_bytes: int
    size: tuple[float, float, float]
    origin: tuple[float, float, float]
    meshes: int
    vertices: int
    single_sided: int
    backs_in_sight: int
    counts: Validation
    materials: tuple[MaterialFacts, ...]
    textures: int
    texture_bytes: int
    contents: Contents
    alpha: dict[str, Share]
    notes: tuple[str, ...]
    rig: RigFacts | None = None
    parts: tuple[str, ...] = ()
    copyright: str = ""

    def record(self) -> dict[str, Any]:
        """All of it for JSON, the counts and contents among the rest."""
        out = asdict(self)
        return {**out, **out.pop("counts"), **out.pop("contents")}

    def lines(self) -> list[str]:
        """The same for a terminal; long lists end in a count."""
        x, y, z = (f"{s:.4g}" for s in self.size)
        out = [
            f"file        {self.name}, {_bytes(self.file_bytes)}{_of(self.files, 'files')}",
            f"size        {x} x {y} x {z} m",
            f"triangles   {self.counts.triangles:,} in {_some(self.meshes, 'mesh', 'meshes')}, "
            f"{self.vertices:,} vertices, {_some(self.counts.connected_parts, 'connected part')}",
            f"sides       {self.single_sided:,} triangles single-sided, {self.backs_in_sight:,} with backs in sight",
            f"textures    {self.textures}, {_bytes(self.texture_bytes)} uncompressed",
        ]
        if self.copyright:
            out += _wrap(f"{'copyright':12}", self.copyright)
        for what, names in (
            ("parts", self.parts),
            ("skins", self.contents.skins),
            ("clips", self.contents.clips),
            ("morphs", self.contents.morph_targets),
        ):
            out += _list_names(f"{what:12}", names, f"{len(names)}: ") if names else []
        out += [] if self.rig is None else self.rig.lines()
        out += (
            _list_names(f"{'variants':12}", self.contents.variants)
            if self.contents.variants
            else []
        )
        if any(self.origin):
            out.append(
                "far away    its middle is near ({:.10g}, {:.10g}, {:.10g}) m".format(*self.origin)
            )
        faults = {
            k: v
            for k, v in asdict(self.counts).items()
            if v and k not in ("triangles", "connected_parts")
        }
        out.append(f"to look at  {'' if faults else 'nothing'}".rstrip())
        out += [f"  {name.replace('_', ' '):24}{count:,}" for name, count in faults.items()]
        out.append("simplify")
        out += [
            f"  {kind:24}{_some(s.meshes, 'mesh', 'meshes')}, {s.triangles:,} triangles: {s.becomes}"
            for kind, s in self.alpha.items()
        ]
        out.append(f"materials   {len(self.materials):,}")
        for material in self.materials[:LISTED]:
            out += _material_lines(material)
        if len(self.materials) > LISTED:
            rest = self.materials[LISTED:]
            out.append(
                f"... and {len(rest):,} more, of {sum(m.triangles for m in rest):,} triangles"
            )
        return out + [f"note: {note}" for note in self.notes]


def inspect(
    source: str | Path,
    options: InspectOptions | None = None,
    **values: Any,
) -> Inspection:
    """What is in a file, and what is wrong with it. ``values``: options by flat key, as those of
    ``load``. Raises InputError."""
    options = resolve_options(InspectOptions, options, values)
    read = partial(load, source, **options.asset.arguments())
    given = read(mend=False)
    counts, asset = repair_and_count(given, str(source))
    low, high = asset.bounds()
    parts = separate_opaque(asset)
    fitted = (m for m, out in zip(parts.meshes, kept_apart(parts), strict=True) if not out)
    one_way, backs = sides.counted(tuple(fitted))
    textures = _textures({id(m.material): m.material for m in asset.meshes}.values())
    files = [file for file in dict.fromkeys(asset.files) if file.is_file()]
    x, y, z = (float(s) for s in high - low)
    return Inspection(
        name=Path(source).name,
        files=len(files),
        file_bytes=sum(file.stat().st_size for file in files),
        size=(x, y, z),
        origin=asset.origin,
        meshes=len(asset.meshes),
        vertices=sum(len(m.positions) for m in asset.meshes),
        single_sided=one_way,
        backs_in_sight=backs,
        counts=counts,
        materials=_materials(parts),
        textures=len(textures),
        texture_bytes=sum(t.nbytes for t in textures),
        contents=asset.contents,
        alpha=count_kinds(parts),
        notes=parts.notes,
        parts=_parts(asset),
        copyright=asset.credits.copyright,
        rig=_rig(read) if asset.contents.skins or asset.contents.clips else None,
    )


def _rig(read: Callable[..., Asset]) -> RigFacts | None:
    """Facts of what moves an asset, read again with it; None if nothing does."""
    try:
        asset = read(keep_rig=True)
    except InputError as error:
        return RigFacts(fault=str(error))
    if asset.rig is None:
        return None
    skins = [m.skin for m in asset.meshes if m.skin is not None]
    bones = {int(b) for s in skins for b in np.unique(s.bones[s.weights > 0])}
    counts = np.concatenate([(s.weights > 0).sum(axis=1) for s in skins] or [np.zeros(1, np.int64)])
    return RigFacts(
        joints=len({int(asset.rig.bone_nodes[b]) for b in bones}),
        influences=int(counts.max(initial=0)),
        mean_influences=float(counts.mean()),
        rigid_meshes=sum(s.rigid for s in skins),
        rate=asset.rig.rate,
        animations=tuple(ClipFacts(c.name, c.duration, c.keys) for c in asset.rig.clips),
    )


def _parts(asset: Asset) -> tuple[str, ...]:
    """Names of the nodes that have meshes, as in the file."""
    if not asset.nodes:
        return ()
    used = sorted({m.node for m in asset.meshes if m.node is not None})
    return tuple(asset.nodes[k].name for k in used)


def _textures(materials: Any) -> list[np.ndarray]:
    """The pixels of all textures, each once."""
    every = (getattr(m, name) for m in materials for name in MAPS)
    return list({id(t.pixels): t.pixels for t in every if t is not None}.values())


def _materials(asset: Asset) -> tuple[MaterialFacts, ...]:
    """The materials in the order of their triangles."""
    wearers: dict[int, list[Mesh]] = {}
    kept: dict[int, bool] = {}
    for mesh, out in zip(asset.meshes, kept_apart(asset), strict=True):
        wearers.setdefault(id(mesh.material), []).append(mesh)
        kept[id(mesh.material)] = out
    facts = [_facts(meshes[0].material, meshes, kept[key]) for key, meshes in wearers.items()]
    return tuple(sorted(facts, key=lambda m: -m.triangles))


def _facts(material: Material, meshes: Sequence[Mesh], kept: bool) -> MaterialFacts:
    given = ((name, getattr(material, name)) for name in MAPS)
    return MaterialFacts(
        name=material.name,
        meshes=len(meshes),
        triangles=sum(len(m.faces) for m in meshes),
        seen=kind_of(material) + (f", {UNLIT}" if material.unlit else ""),
        double_sided=material.double_sided,
        simplify=KEPT if kept else FITTED,
        maps=tuple(
            _map_facts(MAPS[name], texture) for name, texture in given if texture is not None
        ),
    )


def _map_facts(name: str, texture: Texture) -> MapFacts:
    height, width, channels = texture.pixels.shape
    return MapFacts(name, width, height, channels, 8 * texture.pixels.itemsize, texture.color_space)


def _material_lines(m: MaterialFacts) -> list[str]:
    sides = "both sides" if m.double_sided else "one side"
    worn = "" if m.meshes == 1 else f" in {m.meshes:,} meshes"
    head = f"'{m.name}': {m.triangles:,} triangles{worn}, {m.seen}, {sides}; {m.simplify}"
    spaces = {"srgb": "sRGB", "linear": "linear"}
    maps = [
        f"{t.map} {t.width} x {t.height}, {t.bits} bit, {spaces[t.color_space]}" for t in m.maps
    ]
    return [*_wrap("  ", head), *(line for text in maps for line in _wrap("      ", text))]


def _list_names(head: str, names: Sequence[str], count: str = "") -> list[str]:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return _wrap(head, count + ", ".join(names[:LISTED]) + more)


def _wrap(head: str, text: str) -> list[str]:
    return textwrap.wrap(
        text, COLUMNS, initial_indent=head, subsequent_indent=" " * max(len(head), 6)
    )


def _some(count: int, one: str, many: str = "") -> str:
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def _of(count: int, what: str) -> str:
    return f" in {count} {what}" if count != 1 else ""


def _bytes(count: int) -> str:
    size, unit = float(count), "B"
    for larger in ("KiB", "MiB", "GiB"):
        if size < 1024:
            break
        size, unit = size / 1024, larger
    return f"{size:.3g} {unit}" if size < 1000 else f"{size:.0f} {unit}"
