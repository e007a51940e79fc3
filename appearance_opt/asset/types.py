"""What a file holds, on the host, in NumPy. Nothing here knows of a renderer.

Conventions, the same in the whole package (they are glTF 2.0's):

- right-handed, **+Y up**, metres; counter-clockwise faces look outward;
- texture coordinates: (0, 0) is the **top left** corner of the image, v grows downward;
- row 0 of a texture is its top row;
- base-colour textures are sRGB encoded, all others linear; factors are linear;
- normal maps: tangent space, green up ("OpenGL"), stored as ``(n + 1) / 2``;
- tangents ``(x, y, z, w)`` with bitangent = w * cross(normal, tangent).

Loaders convert what they read to these conventions; savers convert back.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from appearance_opt.asset.rig import Rig, Skin

ColorSpace = Literal["srgb", "linear"]
Wrap = Literal["repeat", "clamp", "mirror"]
AlphaMode = Literal["opaque", "mask", "blend"]


@dataclass(frozen=True)
class Texture:
    """An image as stored.

    ``pixels``: (H, W, C), C in 1..4, row 0 on top; uint8 and uint16 stand for [0, 1], float32 for
    itself. ``color_space`` says how to decode the first three channels; a fourth channel (alpha) is
    always linear.
    """

    pixels: NDArray
    color_space: ColorSpace = "linear"
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def linear(self) -> NDArray[np.float32]:
        """Decoded pixels: (H, W, C) float32, linear."""
        x = self.pixels
        if x.dtype == np.uint8 and self.color_space == "srgb":
            table = srgb_to_linear(np.arange(256, dtype=np.float32) / np.float32(255))
            out = table[x]
            if x.shape[2] == 4:
                out[..., 3] = x[..., 3].astype(np.float32) / np.float32(255)
            return out
        if x.dtype == np.uint8:
            out = x.astype(np.float32) / np.float32(255)
        elif x.dtype == np.uint16:
            out = x.astype(np.float32) / np.float32(65535)
        else:
            out = x.astype(np.float32)
        if self.color_space == "srgb":
            out[..., :3] = srgb_to_linear(out[..., :3])
        return out


@dataclass(frozen=True)
class Displacement:
    """A height map: the surface moves by ``scale * (texel - mid)`` metres along its unit normal.

    ``texture``: one linear channel, uint16 (0 to 65535 stand for 0 to 1) or float32 (any value).
    """

    texture: Texture
    scale: float = 1.0
    mid: float = 0.0


@dataclass(frozen=True)
class Volume:
    """What light passes through inside of a transmissive object (glTF 2.0's KHR_materials_volume,
    whose units are metres): carried over, drawn by no renderer here."""

    thickness: float = 0.0
    attenuation_distance: float = float("inf")
    attenuation_color: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Material:
    """glTF 2.0 metallic-roughness material (what a texture gives is multiplied by its factor).

    ``base_color``: linear RGB factor. ``orm_texture``: R occlusion (not used by the renderer;
    written as occlusion if ``has_occlusion``), G roughness, B metalness, as glTF packs them.
    ``displacement`` is written where a format has it; no renderer here reads it. ``emission``:
    linear RGB factor, may exceed 1, and its sRGB texture: carried over, drawn by no renderer here,
    for it does not depend on any light.

    Alpha is ``opacity`` times the fourth channels of ``base_color_texture`` and of vertex colours.
    It means nothing with the ``alpha_mode`` "opaque"; with "mask" the surface is there where alpha
    is at least ``alpha_cutoff``; with "blend" alpha is its coverage. ``transmission``: share of the
    light that passes through (times the red channel of its texture); ``ior``, ``volume`` and the
    green channel of ``thickness_texture`` are carried over beside it.

    ``unlit``: shown in its base colour whatever the light, as if it were a picture of itself
    (KHR_materials_unlit).
    """

    name: str = "material"
    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    roughness: float = 1.0
    metalness: float = 0.0
    normal_scale: float = 1.0
    base_color_texture: Texture | None = None
    orm_texture: Texture | None = None
    normal_texture: Texture | None = None
    displacement: Displacement | None = None
    has_occlusion: bool = False
    opacity: float = 1.0
    alpha_mode: AlphaMode = "opaque"
    alpha_cutoff: float = 0.5
    double_sided: bool = True
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: Texture | None = None
    transmission: float = 0.0
    transmission_texture: Texture | None = None
    ior: float = 1.5
    volume: Volume | None = None
    thickness_texture: Texture | None = None
    unlit: bool = False

    @property
    def emits(self) -> bool:
        """Does it glow? The texture is multiplied by the factor."""
        return any(self.emission)


@dataclass(frozen=True)
class Mesh:
    """One indexed triangle mesh with one material, in world space.

    ``positions`` (V, 3) float32; ``faces`` (F, 3) int32; ``normals`` (V, 3) unit or None (none in
    the file); ``uvs`` (V, 2) or None; ``tangents`` (V, 4) or None; ``colors`` (V, 3) linear vertex
    colours, (V, 4) with alpha, or None. Vertices are split at UV and normal seams, as in the file.
    ``node``: number of the asset's node to which it belongs, None for none.
    With a ``skin`` it is in the bind space of the asset's rig instead of world space.
    """

    positions: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32] | None = None
    uvs: NDArray[np.float32] | None = None
    tangents: NDArray[np.float32] | None = None
    colors: NDArray[np.float32] | None = None
    material: Material = field(default_factory=Material)
    name: str = "mesh"
    node: int | None = None
    skin: Skin | None = None

    def take(self, vertices: NDArray, faces: NDArray) -> Mesh:
        """The mesh with some of its vertices, in any order, and ``faces`` (F, 3) among them."""
        names = ("positions", "normals", "uvs", "tangents", "colors")
        kept = {n: values[vertices] for n in names if (values := getattr(self, n)) is not None}
        skin = None if self.skin is None else self.skin.take(vertices)
        return replace(self, faces=faces.astype(np.int32), skin=skin, **kept)


@dataclass(frozen=True)
class Node:
    """A node of a file's hierarchy: a part that an engine knows by its name and moves about its
    pivot, the origin of its coordinates. ``parent``: number of the node above it, smaller than its
    own; None at the top. ``matrix``: (4, 4) double precision, from its coordinates to its parent's,
    of columns (y = M x). ``extras``: what the file's authors say of it (JSON values), or None."""

    name: str
    parent: int | None = None
    matrix: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    extras: Any = None


@dataclass(frozen=True)
class Credits:
    """What a file says of itself. ``copyright``: the line that its owners ask to be shown;
    ``extras``: other values of its authors (JSON), or None; ``lighting``: what light its colours
    hold, if they hold any."""

    copyright: str = ""
    extras: Any = None
    lighting: str = ""


@dataclass(frozen=True)
class Contents:
    """Names of what a file holds beside its surfaces: ``skins`` (in USD skeletons), ``clips`` of
    animation, ``variants`` as ``--variant`` takes them, ``morph_targets`` (in USD blend shapes)."""

    skins: tuple[str, ...] = ()
    clips: tuple[str, ...] = ()
    variants: tuple[str, ...] = ()
    morph_targets: tuple[str, ...] = ()


@dataclass(frozen=True)
class Asset:
    """All meshes of one file, node transforms applied. ``notes`` lists, one line each, what the
    loader dropped, repaired or assumed; ``files``, absolute paths of the files that it refers to;
    ``origin``: the place of the meshes in the world, which is origin + positions (metres, double
    precision), zero but for what lies far away for its size; ``nodes``, a parent before its
    children: the hierarchy of the meshes, whose transforms are applied already, empty for one mesh
    beside the other; ``rig``: what moves the meshes that have a skin, with a hierarchy of its own,
    None for what stands still."""

    meshes: tuple[Mesh, ...]
    name: str = "asset"
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    contents: Contents = field(default_factory=Contents)
    nodes: tuple[Node, ...] = ()
    credits: Credits = field(default_factory=Credits)
    rig: Rig | None = None

    @property
    def triangle_count(self) -> int:
        return sum(len(m.faces) for m in self.meshes)

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners (3,), (3,) of the axis-aligned box around all referenced vertices, in the
        world."""
        used = [
            m.positions[_marked(m.faces, len(m.positions))] for m in self.meshes if len(m.faces)
        ]
        low = np.min([p.min(axis=0) for p in used], axis=0).astype(np.float64)
        high = np.max([p.max(axis=0) for p in used], axis=0).astype(np.float64)
        return low + self.origin, high + self.origin

    def points(self) -> NDArray[np.float64]:
        """(N, 3) all vertices, in the world."""
        return np.concatenate([m.positions for m in self.meshes]).astype(np.float64) + self.origin


def _marked(indices: NDArray, count: int) -> NDArray[np.bool_]:
    """(count,) which numbers are among the indices?"""
    out = np.zeros(count, bool)
    out[indices] = True
    return out


def srgb_to_linear(x: NDArray) -> NDArray:
    """IEC 61966-2-1 decoding of values in [0, 1] (any shape)."""
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.0) + 0.055) / 1.055) ** 2.4).astype(
        x.dtype
    )


def linear_to_srgb(x: NDArray) -> NDArray:
    """IEC 61966-2-1 encoding of linear values in [0, 1] (any shape)."""
    return np.where(
        x <= 0.0031308, x * 12.92, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055
    ).astype(x.dtype)
