"""Wavefront MTL, with the PBR extension (Pr, Pm, map_Pr, map_Pm, Ke, norm), to materials."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset import images, udim, uv_transforms, uv_unification
from appearance_opt.asset.packing import pack_orm, with_alpha
from appearance_opt.asset.paths import read_text
from appearance_opt.asset.types import Material, Texture, Wrap
from appearance_opt.errors import InputError, MissingFileError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from appearance_opt.asset.companions import Companions
    from appearance_opt.asset.types import AlphaMode, ColorSpace, Mesh
    from appearance_opt.asset.udim import Tile

_MAP_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1,
    "-clamp": 1, "-bm": 1, "-imfchan": 1, "-type": 1, "-cc": 1,
    "-colorspace": 1,
}  # fmt: skip
"""Options of map statements and how many values follow them, at most for those of ``_OPTIONAL``."""

_OPTIONAL = ("-o", "-s", "-t")
"""Options whose second and third values may be left out (MTL specification, "Options for texture
map statements")."""

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")

_COMMENT = re.compile(r"\s#")

_NORMAL, _BUMP = ("norm", "map_kn"), ("map_bump", "bump")
_USED = ("map_kd", "map_pr", "map_pm", "map_ke", "map_ka", "map_d", "map_aat", *_NORMAL, *_BUMP)
"""Maps that are read; that of the ambient colour, which lights nothing here, usually repeats the
diffuse one, and ``map_aat`` is a switch, not a map."""

_FILES = ("map_", "norm", "bump", "disp", "decal", "refl")
"""Start of the statements that name a file, whether it is read or not."""

WITHOUT_MAP, LOST = "# without its map: ", "lost:"
"""Start of the comments in which our own files keep a constant for when its map gets lost, and what
stands for it here before the constant's key. The maps hold the factors there, and the constants
beside them are 1 (see ``obj_write``)."""

UNLIT_MARK, UNLIT = "# unlit", "unlit"
"""Comment by which our own files say that a material is shown without light, and its key here.
Others that write "illum 0", which means that, too, seldom mean it."""

ALPHA_TEST, TESTED = "# alpha test: ", "tested"
"""Start of the comment in which our own files keep the cutoff of a material with the alpha mode
"mask", for which the format has no word, and its key here."""

UNIT, MOSTLY = 0.1, 0.9
"""A picture is taken for a normal map if at least the share ``MOSTLY`` of its texels, decoded, have
a length within ``UNIT`` of 1 and point outward."""


@dataclass(frozen=True)
class _Map:
    """A map statement: the file, and what its options say. ``transform``: (2, 3), from texture
    coordinates to the map's."""

    file: str
    wrap: Wrap = "repeat"
    strength: float = 1.0
    channel: int | None = None
    transform: NDArray[np.float64] = field(default_factory=lambda: uv_transforms.affine(None))
    ignored: tuple[str, ...] = ()


class MaterialReader:
    """Materials of the MTL files of one OBJ file: ``by_name``, and by ``id`` of a material the
    ``transforms`` of its textures (see ``uv_unification.unify``), and what reads its ``tiles`` if
    they have any (see ``udim.split``)."""

    def __init__(self, companions: Companions) -> None:
        self.companions, self.note = companions, companions.note
        self.by_name: dict[str, Material] = {}
        self.transforms: dict[int, dict[str, uv_transforms.UvTransform]] = {}
        self.tiles: dict[int, Callable[[Tile], Material]] = {}
        self._files: set[Path] = set()

    def read(self, path: Path) -> None:
        """Add the materials of a file, once. Raises InputError."""
        if path in self._files:
            return
        self._files.add(path)
        statements: dict[str, dict[str, str]] = {}
        current: dict[str, str] = {}
        for line in read_text(path).splitlines():
            if line.startswith(WITHOUT_MAP):
                line = LOST + line[len(WITHOUT_MAP) :]
            elif line == UNLIT_MARK:
                line = f"{UNLIT} 1"
            elif line.startswith(ALPHA_TEST):
                line = f"{TESTED} {line[len(ALPHA_TEST) :]}"
            words = line.split(None, 1)
            if len(words) < 2 or words[0].startswith("#"):
                continue
            if words[0] == "newmtl":
                current = statements.setdefault(words[1].strip(), {})
            else:
                current[words[0].lower()] = words[1].strip()
                if words[0].lower().startswith(_FILES):
                    for name in (words[1].strip(), words[1].split()[-1]):
                        self.companions.mention(name, path)
        for name, values in statements.items():
            self.by_name[name] = self._material(name, values, path)
            if any(udim.is_tiled(v) for v in values.values()):
                self.tiles[id(self.by_name[name])] = partial(self._material, name, values, path)

    def _material(
        self, name: str, values: dict[str, str], path: Path, tile: Tile | None = None
    ) -> Material:
        try:
            one = _Statements(name, values, path, self.companions, tile)
            material = one.material()
        except (ValueError, IndexError):
            raise InputError(
                f"{path}: a value of material '{name}' is missing or not a number"
            ) from None
        self.transforms[id(material)] = one.transforms
        return material

    def apply_uv_transforms(self, meshes: list[Mesh], keep_layout: bool) -> list[Mesh]:
        """The meshes as their textures read them; see ``uv_unification.apply_all``."""
        return uv_unification.apply_all(meshes, self.transforms, self.note, self.tiles, keep_layout)


class _Statements:
    """The statements of one material, by lower-case key; of one tile of its textures, or without
    those in tiles."""

    def __init__(
        self,
        name: str,
        values: dict[str, str],
        path: Path,
        companions: Companions,
        tile: Tile | None,
    ) -> None:
        self.name, self.values, self.path, self.companions, self.tile = (
            name,
            values,
            path,
            companions,
            tile,
        )
        self.transforms: dict[str, uv_transforms.UvTransform] = {}

    def material(self) -> Material:
        """Phong exponents become roughness sqrt(2 / (Ns + 2)). Constants beside a map are ignored,
        for many exporters write 0 or 0.8 there, and Blender ignores them, too; without the map they
        count."""
        color = self._numbers("kd", [0.8, 0.8, 0.8])
        color = color * 3 if len(color) == 1 else color
        base = self._texture("base_color_texture", "map_kd", space="srgb")
        shininess = self._numbers("ns", [1.125])[0]
        roughness = self._numbers("pr", [float(np.sqrt(2 / (max(shininess, 0.0) + 2)))])[0]
        rough_map = self._texture("orm_texture", "map_pr", one_channel=True)
        metal_map = self._texture("orm_texture", "map_pm", one_channel=True)
        glow_map = self._texture("emission_texture", "map_ke", space="srgb")
        # without the map that says where it glows, nothing does
        lost = glow_map is None and "map_ke" in self.values
        glow = [0.0] * 3 if lost else self._numbers("ke", [float(glow_map is not None)] * 3)
        unlit = UNLIT in self.values
        normal, strength = self._normal()
        opacity, alpha_map = self._opacity()
        self._note_what_is_dropped()
        return Material(
            name=self.name,
            base_color=(1.0, 1.0, 1.0) if base is not None else (color[0], color[1], color[2]),
            roughness=1.0 if rough_map is not None else min(max(roughness, 0.0), 1.0),
            metalness=1.0 if metal_map is not None else self._numbers("pm", [0.0])[0],
            normal_scale=strength,
            base_color_texture=base if alpha_map is None else with_alpha(base, alpha_map),
            orm_texture=None
            if rough_map is None and metal_map is None
            else pack_orm(rough_map, metal_map),
            normal_texture=normal,
            opacity=opacity,
            alpha_mode=self._alpha_mode(opacity < 1 or alpha_map is not None),
            alpha_cutoff=self._numbers(TESTED, [0.5])[0],
            emission=(glow[0], glow[1], glow[2]),
            emission_texture=glow_map,
            unlit=unlit,
        )

    def _numbers(self, key: str, default: list[float]) -> list[float]:
        text = self.values.get(LOST + key, self.values.get(key))
        return default if text is None else [float(w) for w in text.split()[:3]]

    def _normal(self) -> tuple[Texture | None, float]:
        """(normal map, strength). What is named as a bump map is often one; a true bump map holds
        heights, and has no place here."""
        key = next((k for k in (*_NORMAL, *_BUMP) if k in self.values), None)
        if key is None:
            return None, 1.0
        texture = self._texture("normal_texture", key)
        if texture is not None and key in _BUMP and not looks_like_normals(texture):
            self._note(
                f"its bump map '{_map(self.values[key]).file}' ignored: it holds heights, not normals"
            )
            return None, 1.0
        return texture, _map(self.values[key]).strength

    def _texture(
        self, slot: str, key: str, space: ColorSpace = "linear", one_channel: bool = False
    ) -> Texture | None:
        """The map of a statement; None without one, or if it is missing and that is to be
        ignored."""
        if key not in self.values:
            return None
        given = _map(self.values[key])
        pixels = self._pixels(given.file)
        if pixels is None:
            if udim.is_tiled(given.file):
                self.transforms.setdefault(slot, uv_transforms.UvTransform(given.transform))
            return None
        if given.ignored:
            self._note(f"{' '.join(given.ignored)} of {key} ignored")
        if slot in self.transforms and not np.allclose(
            self.transforms[slot].matrix, given.transform
        ):
            which = "roughness and metalness" if slot == "orm_texture" else "colour and alpha"
            self._note(f"the maps of {which} differ in transform: the first one's is used for both")
        self.transforms.setdefault(slot, uv_transforms.UvTransform(given.transform))
        if one_channel:
            channel = given.channel
            if channel is None:  # what is named as a map of alpha is often a picture with alpha
                alpha = pixels.shape[2] - 1
                has_alpha = (
                    key == "map_d" and alpha in (1, 3) and pixels[..., alpha].min() < _one(pixels)
                )
                channel = alpha if has_alpha else 0
            pixels = pixels[..., min(channel, pixels.shape[2] - 1)][..., None]
        else:
            pixels = images.to_color(pixels)
        if pixels.dtype.kind == "f":  # EXR and HDR files are linear
            space = "linear"
        texture = Texture(np.ascontiguousarray(pixels), space, (given.wrap, given.wrap))
        if self.tile is None or not udim.is_tiled(given.file):
            return texture
        return udim.fit_to_tile(texture, self.tile, self.companions)

    def _pixels(self, file: str) -> NDArray | None:
        """None if the file is missing and that is to be ignored, or if it is one in tiles and none
        is asked for."""

        def read(name: str) -> NDArray:
            try:
                found = self.companions.find(name, self.path)
            except MissingFileError:
                # what is behind a # may belong to the name, or be a comment
                plain = _COMMENT.split(name)[0].strip()
                if not plain or plain == name:
                    raise
                found = self.companions.find(plain, self.path)
            return self.companions.picture(found)

        if not udim.is_tiled(file):
            return self.companions.read(lambda: read(file))
        if self.tile is None:
            return None
        return udim.read_tile(file, self.tile, self.path, self.companions, read)

    def _opacity(self) -> tuple[float, Texture | None]:
        """(factor, map) of alpha. The format has no alpha test: our own files keep theirs in a
        comment."""
        alpha_map = self._texture("base_color_texture", "map_d", one_channel=True)
        if alpha_map is not None:
            return 1.0, alpha_map
        opacity = 1 - self._numbers("tr", [0.0])[0]
        if "d" in self.values:
            opacity = float(self.values["d"].split()[-1])  # it may have the option -halo
        if opacity <= 0:
            self._note(
                "says that nothing of it is seen (d 0 or Tr 1), as some exporters do of all: drawn opaque"
            )
            opacity = 1.0
        return opacity, None

    def _alpha_mode(self, transparent: bool) -> AlphaMode:
        if not transparent:
            return "opaque"
        return "mask" if TESTED in self.values else "blend"

    def _note_what_is_dropped(self) -> None:
        maps = [k for k in self.values if k.startswith("map_") or k in ("disp", "decal", "refl")]
        dropped = [k for k in maps if k not in _USED]
        if dropped:
            self._note(f"{', '.join(dropped)} ignored")

    def _note(self, text: str) -> None:
        self.companions.note(f"material '{self.name}': {text}")


def _map(statement: str) -> _Map:
    """The parts of a map statement. The name of the file, which may have spaces and quotation
    marks, is what is left after the options. Raises ValueError and IndexError for values that are
    missing."""
    found: dict[str, list[str]] = {}
    rest = statement.strip()
    while (option := rest.split(None, 1)[0] if rest else "") in _MAP_OPTIONS:
        values, rest = _taken(rest[len(option) :].lstrip(), option)
        found[option] = values
    offset, scale = (
        _numbers(found.get(o, []), default) for o, default in (("-o", 0.0), ("-s", 1.0))
    )
    ignored = [o for o in ("-t", "-mm", "-boost") if o in found]
    if found.get("-mm") and [float(x) for x in found["-mm"]] == [0, 1]:
        ignored.remove("-mm")
    return _Map(
        file=rest[1:-1] if len(rest) > 2 and rest[0] == rest[-1] == '"' else rest,
        wrap="clamp" if found.get("-clamp") == ["on"] else "repeat",
        strength=float(found.get("-bm", ["1"])[0]),
        channel={"r": 0, "g": 1, "b": 2, "m": 3}.get(found.get("-imfchan", ["l"])[0]),
        transform=uv_transforms.usd_affine(scale[:2], 0.0, offset[:2]),  # these count v upward, too
        ignored=tuple(ignored),
    )


def _taken(text: str, option: str) -> tuple[list[str], str]:
    """(values of an option, the rest of the statement)."""
    values: list[str] = []
    while len(values) < _MAP_OPTIONS[option]:
        word, rest = (text.split(None, 1) + ["", ""])[:2]
        if values and option in _OPTIONAL and not (rest and _NUMBER.fullmatch(word)):
            break  # the name of the file, even if it is a number
        if not word:
            raise ValueError
        values.append(word)
        text = rest
    return values, text


def _numbers(words: list[str], default: float) -> tuple[float, float, float]:
    u, v, w = [*(float(x) for x in words), *(default,) * 3][:3]
    return u, v, w


def _one(pixels: NDArray) -> float:
    """What stands for 1 in pixels."""
    return np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0


def looks_like_normals(texture: Texture) -> bool:
    """Is a picture a tangent-space normal map? See ``MOSTLY``."""
    n = texture.linear()[..., :3] * 2 - 1
    fits = (np.abs(np.linalg.norm(n, axis=-1) - 1) < UNIT) & (n[..., 2] > 0)
    return bool(fits.mean() >= MOSTLY)
