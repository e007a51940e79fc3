"""What a glTF file holds that no result will: one line for each kind, with a count."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from appearance_opt.asset.alpha import list_names
from appearance_opt.asset.notes import counted

if TYPE_CHECKING:
    from collections.abc import Mapping

    from appearance_opt.asset.gltf_accessors import Document

LIGHTS = "KHR_lights_punctual"
COUNTED = (LIGHTS,)
"""Extensions of which these notes tell."""

_READ = ("POSITION", "NORMAL", "TANGENT", "COLOR_0", "JOINTS_", "WEIGHTS_", "TEXCOORD_")


def note_dropped(document: Document, sets_read: Mapping[int | None, list[int]]) -> None:
    """Note cameras, lights, texture coordinates that no texture reads (``sets_read``: those that
    are, by material), vertex attributes of other kinds, and extras of what is not written again."""
    note = document.companions.note
    lights = document.extension(LIGHTS).get("lights", [])
    for items, what in ((document.items("cameras"), "camera"), (lights, "light")):
        if items:
            names = [str(x.get("name", f"{what}{k}")) for k, x in enumerate(items)]
            note(f"{counted(len(items), what)} dropped ({list_names(names)})")
    meshes = document.items("meshes")
    spare, others = set(), set()
    for k, mesh in enumerate(meshes):
        for primitive in mesh["primitives"]:
            used = sets_read.get(primitive.get("material"), [0])
            for name in primitive["attributes"]:
                if name.startswith("TEXCOORD_") and name[9:] not in map(str, used):
                    spare.add(k)
                elif not name.startswith(_READ):
                    others.add(name)
    if spare:
        told = list_names(str(meshes[k].get("name", f"mesh{k}")) for k in sorted(spare))
        note(
            f"texture coordinates that no texture reads dropped, of {counted(len(spare), 'mesh', 'meshes')} "
            f"({told})"
        )
    if others:
        note(f"attributes of vertices dropped: {list_names(sorted(others))}")
    count = sum(_has_extras(x) for kind in _KINDS for x in document.items(kind))
    count += sum(_has_extras(p) for mesh in meshes for p in mesh["primitives"])
    if count:
        note(f"extras of {counted(count, 'object')} dropped (meshes, materials, images, scenes)")


_KINDS = ("meshes", "materials", "textures", "images", "scenes", "cameras")
"""Objects whose extras are not kept: those of nodes and of the file are."""


def _has_extras(item: Any) -> bool:
    """Has it any but the names of morph targets, of which another note tells?"""
    extras = item.get("extras") if isinstance(item, dict) else None
    if isinstance(extras, dict):
        return bool(extras.keys() - {"targetNames"})
    return extras is not None
