"""USD stages to an Asset: composition, transforms, subsets, primvars, subdivision."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from appearance_opt.asset import usd_nodes, usd_shapes, uv_transforms
from appearance_opt.asset.alpha import OPAQUE, list_names
from appearance_opt.asset.batch import fill_normals
from appearance_opt.asset.companions import Companions
from appearance_opt.asset.instances import Instances, place_copies
from appearance_opt.asset.normals import accumulate, unit
from appearance_opt.asset.notes import Notes
from appearance_opt.asset.origin import ZERO, settle
from appearance_opt.asset.paths import check_inside, common_folder, read_bytes
from appearance_opt.asset.polygons import Polygons, triangulate
from appearance_opt.asset.rows import rank_rows, unique_rows
from appearance_opt.asset.subdivide import Sharpness, catmull_clark
from appearance_opt.asset.types import Asset, Contents, Mesh
from appearance_opt.asset.usd_blend import blend_shapes, shape_names
from appearance_opt.asset.usd_guard import check_usd
from appearance_opt.asset.usd_materials import MaterialReader
from appearance_opt.asset.usd_rig import RigReader, dense, refined_influences
from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Skin

_TO_Y_UP = {
    "Y": np.eye(3),
    "Z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "X": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}

_REFINED = ("catmullClark", "loop")
"""Schemes of subdivision surfaces that are refined."""

_UVS = "uvs:"
"""Before the name of a primvar of texture coordinates, among the attributes of a mesh."""


_ADDRESS = re.compile(r" \(instantiating stage .*$")
"""What USD adds to its warnings: the same for all of them, and an address in memory."""


def load_usd(
    path: Path,
    refine: int = 1,
    variants: dict[str, str] | None = None,
    companions: Companions | None = None,
    keep_layout: bool = False,
    keep_rig: bool = False,
) -> Asset:
    """Read a stage at its earliest time, variants at their selection (or as ``variants`` says: set
    name -> variant, on the default prim). Catmull-Clark and Loop meshes are refined ``refine``
    times. ``keep_layout``, ``keep_rig``: see ``asset.load``. Raises InputError."""
    from pxr import Tf, UsdUtils

    path = Path(path)
    check_usd(read_bytes(path), path)
    # USD prints what it warns of; here it becomes notes
    companions = companions or Companions()
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        asset = _read_stage(path, refine, variants or {}, companions, keep_layout, keep_rig)
    except Tf.ErrorException as error:
        # the first of what went wrong: the place in the file, if it is text
        said = [
            _text(partial(getattr, one, "commentary"))
            for one in error.args
            if hasattr(one, "commentary")
        ]
        raise InputError(
            f"{path}: not a readable USD file ({(said or [_text(error.__str__)])[0]})"
        ) from None
    finally:
        warned = [
            _text(partial(getattr, w, "commentary"))
            for w in diagnostics.TakeUncoalescedDiagnostics()
        ]
    told = Notes()
    for warning in warned:
        text = _ADDRESS.sub("", warning)
        if any(f"{file.name}@" in text for file in companions.files if file.suffix == ".mtlx"):
            continue  # read without USD, which has no reader of MaterialX documents
        # of one kind are those that differ in paths and names of files only
        told(f"USD: {text}", re.sub(r"<[^>]*>|@[^@]*@|'[^']*'", "...", text))
    return replace(asset, notes=asset.notes + told.lines())


def _read_stage(
    path: Path,
    refine: int,
    variants: dict[str, str],
    companions: Companions,
    keep_layout: bool,
    keep_rig: bool,
) -> Asset:
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    if stage is None:
        raise InputError(f"{path}: not a readable USD file")
    _select(stage, variants, path)
    _refuse_escapes(stage, path, companions)
    _mention_all(stage, path, companions)
    return _Reader(stage, path, refine, companions, keep_layout, keep_rig).asset()


def _select(stage: Any, variants: dict[str, str], path: Path) -> None:
    prim = stage.GetDefaultPrim()
    stage.SetEditTarget(stage.GetSessionLayer())
    for name, choice in variants.items():
        if not name:
            raise InputError(f"{path}: --variant {choice}: write it as set=name")
        sets = prim.GetVariantSets() if prim else None
        if (
            sets is None
            or not sets.HasVariantSet(name)
            or choice not in sets.GetVariantSet(name).GetVariantNames()
        ):
            have = (
                {n: sets.GetVariantSet(n).GetVariantNames() for n in sets.GetNames()}
                if sets
                else {}
            )
            raise InputError(f"{path}: has no variant {name}={choice}; there are {have or 'none'}")
        sets.GetVariantSet(name).SetVariantSelection(choice)


def _refuse_escapes(stage: Any, path: Path, companions: Companions) -> None:
    """Layers outside the folder of the root layer, or the one that is allowed, are not read on
    behalf of it. Raises InputError, which names the folder to allow for all that the asset refers
    to."""
    for layer in stage.GetUsedLayers():
        if layer.anonymous or not layer.realPath:
            continue
        file = Path(layer.realPath.split("[")[0])
        try:
            check_inside(file, path, layer.identifier, companions.root)
        except InputError:
            raise InputError(
                f"{path}: refers to '{layer.identifier}' outside its own folder; allow the folder of all it needs: "
                f"--root {_folder_of_all(stage, path, companions.root)}"
            ) from None
        companions.files.append(file.resolve())


def _folder_of_all(stage: Any, path: Path, root: Path | None) -> Path:
    """The folder that holds the layers and files of a stage that lie outside of its own folder."""
    from pxr import UsdUtils

    layers, files, _ = UsdUtils.ComputeAllDependencies(stage.GetRootLayer().identifier)
    names = [
        *(layer.realPath for layer in layers),
        *files,
        *(layer.realPath for layer in stage.GetUsedLayers()),
    ]
    folders = {Path(name.split("[")[0]).resolve().parent for name in names if name}
    own = path.resolve().parent
    outside = [folder for folder in folders if not folder.is_relative_to(own)]
    return common_folder([*outside, *([] if root is None else [root.resolve()])])


def _mention_all(stage: Any, path: Path, companions: Companions) -> None:
    """Layers and packages, and whatever they refer to: layers of variants that are not chosen,
    pictures that no material shows."""
    from pxr import UsdUtils

    for layer in stage.GetUsedLayers():
        if layer.anonymous or not layer.realPath:
            continue
        file = Path(layer.realPath.split("[")[0])
        companions.mention(str(file), path)
        for references in UsdUtils.ExtractExternalReferences(layer.identifier):
            for reference in references:
                companions.mention(reference.split("[")[0], file)


def _metres_per_unit(stage: Any) -> float:
    """The unit of a stage: centimetres if it has none. Some writers give it single precision, which
    ``UsdGeom.GetStageMetersPerUnit`` refuses."""
    root = stage.GetRootLayer().pseudoRoot
    key = "metersPerUnit"
    return float(root.GetInfo(key)) if root.HasInfo(key) else 0.01


def _count_prims(stage: Any) -> int:
    """Prims of a stage, those of instances counted as often as they are instanced: a walk through
    instances of instances may be far longer than the file."""
    from pxr import Usd

    below: dict[str, int] = {}

    def count(root: Any) -> int:
        path = str(root.GetPath())
        if path not in below:
            below[path] = 0
            prims = list(Usd.PrimRange(root))
            inside = (count(p.GetPrototype()) for p in prims if p.IsInstance())
            below[path] = len(prims) + sum(inside)
        return below[path]

    return count(stage.GetPseudoRoot())


@dataclass(frozen=True)
class _Geometry:
    """A mesh in its own coordinates. ``values``: positions ("points") and other attributes by name,
    each with faces of its own; ``face_ids``: the file's face of each face; ``flipped``: do faces
    turn clockwise? ``holes``: faces of the file that are not drawn; ``skin``: influences of the
    file's points, whose numbers are among the values as "skin", or, refined, weights."""

    values: dict[str, tuple[NDArray, Polygons]]
    face_ids: NDArray[np.int64]
    flipped: bool
    holes: NDArray[np.int64]
    skin: Skin | None = None


class _Reader:
    def __init__(
        self,
        stage: Any,
        path: Path,
        refine: int,
        companions: Companions,
        keep_layout: bool,
        keep_rig: bool,
    ) -> None:
        from pxr import Usd, UsdGeom

        self.stage, self.path, self.refine, self.keep_layout = stage, path, refine, keep_layout
        self.companions, self.note = companions, companions.note
        self.to_metres = _TO_Y_UP[str(UsdGeom.GetStageUpAxis(stage))] * _metres_per_unit(stage)
        self.materials = MaterialReader(stage, path, companions)
        # the first frame of what is animated
        self.time = Usd.TimeCode.EarliestTime()
        self.cache = UsdGeom.XformCache(self.time)
        self._read: dict[tuple[str, ...], list[Mesh]] = {}
        self.prims = usd_nodes.Prims(self.cache, self.to_metres)
        self.rig = (
            RigReader(stage, path, self.to_metres, self.time, self.note) if keep_rig else None
        )

    def asset(self) -> Asset:
        from pxr import Usd, UsdGeom

        meshes: list[Mesh] = []
        self.companions.budget.take(_count_prims(self.stage), "prims", self.path)
        prims = iter(Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()))
        for prim in prims:
            if prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()  # its prototypes are drawn where it says
                meshes += self.prims.own(prim, self._instances(prim))
            elif prim.IsA(UsdGeom.Gprim) and self._shown(prim):
                parts = [self._put_one(prim, part) for part in self._parts(prim)]
                meshes += self.prims.own(prim, parts)
        meshes = self.materials.apply_uv_transforms(meshes, self.keep_layout)
        rig = None if self.rig is None else self.rig.rig()
        origin = ZERO
        if rig is None:
            meshes, origin = settle(meshes, self.note)
        else:
            meshes = [replace(m, positions=m.positions.astype(np.float32)) for m in meshes]
        usd_nodes.note_dropped(self.stage, self.note, self.materials.uv_names)
        return Asset(
            tuple(meshes),
            self.path.stem,
            self.companions.notes.lines(),
            origin=origin,
            contents=self._contents(),
            nodes=() if rig is not None else tuple(self.prims.nodes),
            credits=usd_nodes.credits_of(self.stage),
            rig=rig,
        )

    def _contents(self) -> Contents:
        """Skeletons, animations of theirs or the frames of the stage, and the variants of the
        default prim."""
        found: dict[str, list[str]] = {"Skeleton": [], "SkelAnimation": []}
        shapes: list[str] = []
        for prim in self.stage.Traverse():
            if prim.GetTypeName() in found:
                found[prim.GetTypeName()].append(str(prim.GetName()))
            elif prim.GetTypeName() == "Mesh":
                shapes += shape_names(prim)
        clips, stage = found["SkelAnimation"], self.stage
        if (
            not clips
            and stage.HasAuthoredTimeCodeRange()
            and stage.GetEndTimeCode() > stage.GetStartTimeCode()
        ):
            clips = [f"frames {stage.GetStartTimeCode():g} to {stage.GetEndTimeCode():g}"]
        top = stage.GetDefaultPrim()
        sets = [top.GetVariantSet(name) for name in top.GetVariantSets().GetNames()] if top else []
        variants = [f"{s.GetName()}={choice}" for s in sets for choice in s.GetVariantNames()]
        return Contents(
            tuple(found["Skeleton"]),
            tuple(clips),
            tuple(variants),
            tuple(dict.fromkeys(shapes)),
        )

    def _to_world(self, prim: Any) -> Any:
        """From a mesh's own coordinates to the world. A skinned one is kept at its bind pose,
        where its own transform does not count (UsdSkel, "Skinning a Point"): its geomBindTransform
        leads to the coordinates of its skeleton."""
        from pxr import UsdSkel

        world = self.cache.GetLocalToWorldTransform(prim)
        binding = UsdSkel.BindingAPI(prim)
        if not binding.GetJointIndicesPrimvar().HasValue():
            return world
        if self.rig is None:
            self.note(
                f"'{prim.GetPath()}': the bind pose is kept; `appearance-opt animate` keeps skins"
            )
        skeleton = binding.GetInheritedSkeleton()
        bound = binding.GetGeomBindTransformAttr().Get(self.time)
        if not skeleton:
            return world
        to_world = self.cache.GetLocalToWorldTransform(skeleton.GetPrim())
        return to_world if bound is None else bound * to_world

    def _shown(self, prim: Any) -> bool:
        from pxr import UsdGeom

        imageable = UsdGeom.Imageable(prim)
        purpose = str(imageable.ComputePurpose())
        if imageable.ComputeVisibility(self.time) == UsdGeom.Tokens.invisible:
            self.note(f"'{prim.GetPath()}': hidden, ignored")
        elif purpose in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            self.note(f"'{prim.GetPath()}': of purpose {purpose}, ignored")
        else:
            return True
        return False

    def _instances(self, prim: Any) -> list[Mesh]:
        """The meshes of a PointInstancer's prototypes, each where an instance is."""
        from pxr import Usd, UsdGeom

        if not self._shown(prim):
            return []
        instancer = UsdGeom.PointInstancer(prim)
        number = np.array(instancer.GetProtoIndicesAttr().Get(self.time) or [], np.int64)
        shown = instancer.ComputeMaskAtTime(self.time)
        number = number[np.array(shown, bool)] if len(shown) else number
        self.companions.budget.take(len(number), "instances", self.path)
        transforms = instancer.ComputeInstanceTransformsAtTime(self.time, self.time)
        each = np.array(transforms, np.float64).reshape(-1, 4, 4)
        world = np.array(self.cache.GetLocalToWorldTransform(prim))
        meshes: list[Mesh] = []
        for k, target in enumerate(instancer.GetPrototypesRel().GetForwardedTargets()):
            root = self.stage.GetPrimAtPath(target)
            if not root:
                self.note(f"'{prim.GetPath()}': its prototype '{target}' does not exist")
                continue
            back = self.cache.GetLocalToWorldTransform(root).GetInverse()
            for part in Usd.PrimRange(root, Usd.TraverseInstanceProxies()):
                if part.IsA(UsdGeom.PointInstancer):
                    self.note(
                        f"'{part.GetPath()}': ignored, it is a prototype of another PointInstancer"
                    )
                if not part.IsA(UsdGeom.Gprim) or not self._shown(part):
                    continue
                local = np.array(self._to_world(part) * back)
                place = self._place(local @ each[number == k] @ world)
                # normals of its own for each, so that instances which touch are not smoothed across
                meshes += [self._put(one, place) for one in fill_normals(self._parts(part))]
        return meshes

    def _put_one(self, prim: Any, mesh: Mesh) -> Mesh:
        """A mesh where its prim puts it in the world, or in bind space if there is a rig."""
        if self.rig is None or mesh.skin is None:
            placed = self._put(mesh, self._place([np.array(self._to_world(prim))]))
            moved = None if self.rig is None else self.rig.rigid(prim, len(placed.positions))
            return replace(placed, skin=moved)
        place, skin = self.rig.place(prim, mesh.skin)
        return replace(self._put(mesh, place), skin=skin)

    def _put(self, mesh: Mesh, place: Instances) -> Mesh:
        """A mesh at all its places."""
        self.companions.budget.take_copies(mesh, place.copies, self.path)
        return place_copies(mesh, place, mesh.name)

    def _place(self, to_world: Any) -> Instances:
        """Where the copies of a mesh are, in metres, Y up; ``to_world``: (P, 4, 4) for rows, as USD
        has them."""
        metres = np.eye(4)
        metres[:3, :3] = self.to_metres
        return Instances(metres @ np.asarray(to_world).transpose(0, 2, 1))

    def _parts(self, prim: Any) -> list[Mesh]:
        """The triangles of a mesh or a shape in its own coordinates, in double precision, one mesh
        for each material. What instances share is read once."""
        key = self._shared(prim)
        if key is None:
            return self._split(prim)
        if key not in self._read:
            self._read[key] = self._split(prim)
        return self._read[key]

    def _shared(self, prim: Any) -> tuple[str, ...] | None:
        """What instances have in common that look alike: their prim in the prototype, and what is
        bound to them. None for what is no instance."""
        if not prim.IsInstanceProxy():
            return None
        return str(prim.GetPrimInPrototype().GetPath()), *self.materials.bound_keys(prim)

    def _geometry(self, prim: Any) -> _Geometry | None:
        """A mesh or a shape in its own coordinates; None, with a note, if it is something else."""
        from pxr import UsdGeom

        flipped = str(UsdGeom.Gprim(prim).GetOrientationAttr().Get()) == "leftHanded"
        if prim.IsA(UsdGeom.Mesh):
            holes = UsdGeom.Mesh(prim).GetHoleIndicesAttr().Get(self.time)
            values, face_ids, skin = self._mesh(prim, flipped)
            return _Geometry(values, face_ids, flipped, np.array(holes or [], np.int64), skin)
        found = usd_shapes.triangles(prim, self.time)
        if found is None:
            self.note(
                f"{prim.GetTypeName()} '{prim.GetPath()}': ignored, only meshes and plain shapes are read"
            )
            return None
        positions, normals, faces = found
        polygons = Polygons(np.full(len(faces), 3), faces.ravel())
        values = {
            "points": (positions, polygons),
            "normals": (normals, polygons),
            **self._colors(prim, polygons),
        }
        return _Geometry(values, np.arange(len(faces)), flipped, np.empty(0, np.int64))

    def _mesh(
        self, prim: Any, flipped: bool
    ) -> tuple[dict[str, tuple[NDArray, Polygons]], NDArray[np.int64], Skin | None]:
        """Attributes, the file's faces and the influences of a mesh, refined if it is a subdivision
        surface (see ``_Geometry``).

        A polygonal mesh without normals "should be treated and rendered as faceted, with no attempt
        to compute smooth normals" (UsdGeomMesh, "A Note About Normals"), and so are bilinear
        ones."""
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh(prim)
        points = np.array(mesh.GetPointsAttr().Get(self.time) or [], np.float64).reshape(-1, 3)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get(self.time) or [], np.int64)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(self.time) or [], np.int64)
        if counts.sum() != len(indices) or (counts < 0).any():
            raise InputError(
                f"{self.path}, mesh '{prim.GetPath()}': its face counts do not match its indices"
            )
        if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
            raise InputError(
                f"{self.path}, mesh '{prim.GetPath()}': faces refer to points that do not exist"
            )
        refined = 4**self.refine if str(mesh.GetSubdivisionSchemeAttr().Get()) in _REFINED else 1
        self.companions.budget.take(len(points) * refined, "vertices", self.path)
        self.companions.budget.take(len(indices) * refined, "faces", self.path)
        if (counts < 3).any():
            self.note(f"'{prim.GetPath()}': faces with fewer than three corners ignored")
        polygons = Polygons(counts, indices)
        face_ids = np.arange(len(counts))
        shape = blend_shapes(prim, points)
        if shape is not None:
            points = shape[0]
            told = "blend shapes: the shape of their default weights is kept, others are dropped"
            names = "" if self.rig is None else f" ({list_names(shape_names(prim))})"
            self.note(f"'{prim.GetPath()}': {told}{names}")
        values = {"points": (points, polygons)}
        skin = None if self.rig is None else self.rig.influences(prim, len(points))
        if skin is not None:  # the number of each point, or weights to be refined with it
            rows = dense(skin) if refined > 1 else np.arange(float(len(points)))[:, None]
            values["skin"] = rows, polygons
            skin = skin if refined == 1 else None
        for name, (value, where) in self._primvars(prim, mesh, polygons).items():
            values[name] = (value, where)
        if shape is not None and "normals" in values and shape[1].any():
            normals, where = values["normals"]
            point = np.zeros(len(normals), np.int64)
            point[where.indices] = polygons.indices
            if (point[where.indices] == polygons.indices).all():  # none is shared by several points
                values["normals"] = normals + shape[1][point], where
        scheme = str(mesh.GetSubdivisionSchemeAttr().Get())
        if scheme in ("none", "bilinear") and "normals" not in values and not self.keep_layout:
            values["normals"] = _facets(points, polygons, flipped)
        if scheme in _REFINED and self.refine > 0:
            values.pop("normals", None)
            if scheme == "loop":
                self.note("Loop subdivision surfaces are refined by the rules of Catmull-Clark")
            sharpness = {"points": self._sharpness(mesh, len(points))}
            for _ in range(self.refine):
                face_ids = np.repeat(face_ids, values["points"][1].counts)
                for name, (value, where) in values.items():
                    value, where, left = catmull_clark(
                        value, where, name.startswith(_UVS), sharpness.get(name)
                    )
                    values[name] = value, where
                    if name in sharpness:
                        sharpness[name] = left
        return values, face_ids, skin

    def _sharpness(self, mesh: Any, vertices: int) -> Sharpness:
        """Creases and corners of a subdivision surface. Raises InputError if their numbers do not
        fit together."""

        def numbers(attribute: Any, kind: type) -> NDArray:
            return np.array(attribute.Get(self.time) or [], kind)

        indices, lengths = (
            numbers(a, np.int64) for a in (mesh.GetCreaseIndicesAttr(), mesh.GetCreaseLengthsAttr())
        )
        given = numbers(mesh.GetCreaseSharpnessesAttr(), np.float64)
        corners, corner = numbers(mesh.GetCornerIndicesAttr(), np.int64), np.zeros(vertices)
        at_corners = numbers(mesh.GetCornerSharpnessesAttr(), np.float64)
        every = np.concatenate([indices, corners])
        fits = (
            lengths.sum() == len(indices)
            and (lengths > 1).all()
            and len(corners) == len(at_corners)
        )
        fits &= (
            len(given) in (len(lengths), (lengths - 1).sum())
            and not ((every < 0) | (every >= vertices)).any()
        )
        if not fits:
            raise InputError(
                f"{self.path}, mesh '{mesh.GetPath()}': its creases or corners do not fit the mesh"
            )
        corner[corners] = at_corners
        if not len(lengths):
            return Sharpness(np.empty((0, 2), np.int64), np.empty(0), corner)
        inside = np.ones(len(indices), bool)  # does the crease go on after this vertex?
        inside[np.cumsum(lengths) - 1] = False
        at = np.flatnonzero(inside)
        each = given if len(given) == len(at) else np.repeat(given, lengths - 1)
        return Sharpness(np.stack([indices[at], indices[at + 1]], axis=1), each, corner)

    def _primvars(
        self, prim: Any, mesh: Any, polygons: Polygons
    ) -> dict[str, tuple[NDArray, Polygons]]:
        """Normals, texture coordinates and colours, each as values and faces of its own."""
        from pxr import UsdGeom

        api = UsdGeom.PrimvarsAPI(prim)
        out: dict[str, tuple[NDArray, Polygons]] = {}
        for name in self.materials.uv_names(prim):
            uv = api.GetPrimvar(name)
            if uv and uv.HasValue():
                found = _expand(uv.ComputeFlattened(self.time), uv.GetInterpolation(), polygons, 2)
                if found is not None:
                    out[_UVS + name] = (
                        np.stack([found[0][:, 0], 1 - found[0][:, 1]], axis=1),
                        found[1],
                    )
        out |= self._colors(prim, polygons)
        normals = api.GetPrimvar("normals")
        value, how = None, ""
        if normals and normals.HasValue():
            value, how = normals.ComputeFlattened(self.time), normals.GetInterpolation()
        elif mesh.GetNormalsAttr().HasValue():
            value, how = mesh.GetNormalsAttr().Get(self.time), mesh.GetNormalsInterpolation()
        found = _expand(value, how, polygons, 3) if value is not None else None
        if found is not None:
            out["normals"] = found
        return out

    def _colors(self, prim: Any, polygons: Polygons) -> dict[str, tuple[NDArray, Polygons]]:
        from pxr import UsdGeom

        api = UsdGeom.PrimvarsAPI(prim)
        out = {}
        for name, primvar, width in (
            ("colors", "displayColor", 3),
            ("opacity", "displayOpacity", 1),
        ):
            given = api.GetPrimvar(primvar)
            if given and given.HasValue() and self.materials.reads_primvar(prim, primvar):
                found = _expand(
                    given.ComputeFlattened(self.time), given.GetInterpolation(), polygons, width
                )
                if found is not None:
                    out[name] = found
        if "opacity" in out and (out["opacity"][0] >= OPAQUE).all():
            del out["opacity"]
        return out

    def _split(self, prim: Any) -> list[Mesh]:
        """Triangles with one index for all attributes, one mesh per material, in the
        coordinates of a mesh or a shape."""
        geometry = self._geometry(prim)
        if geometry is None:
            return []
        values, face_ids = geometry.values, geometry.face_ids
        points, polygons = values["points"]
        corners, face = triangulate(polygons, points)
        if geometry.flipped:
            corners = corners[:, ::-1]
        meshes = []
        if len(geometry.holes):
            drawn = ~np.isin(face_ids[face], geometry.holes)
            corners, face = corners[drawn], face[drawn]
        for material, uv_names, chosen in self.materials.bindings(
            prim, face_ids[face], "opacity" in values
        ):
            names = [n for n in values if not n.startswith(_UVS) or n[len(_UVS) :] in uv_names]
            rows = np.stack([values[n][1].indices[corners[chosen]].ravel() for n in names], axis=1)
            if not len(rows):
                continue
            of_kind, index = unique_rows(rows)
            used = rows[of_kind]
            got = {n: values[n][0][used[:, k]] for k, n in enumerate(names)}
            uvs = uv_transforms.stack_sets([got.get(_UVS + n) for n in uv_names])
            colors = got.get("colors")
            if "opacity" in got:
                colors = np.ones((len(used), 3)) if colors is None else colors
                colors = np.concatenate([colors, got["opacity"]], axis=1)
            meshes.append(
                Mesh(
                    skin=_skin_of(geometry.skin, got.get("skin")),
                    positions=got["points"],
                    faces=index.reshape(-1, 3).astype(np.int32),
                    normals=got.get("normals"),
                    uvs=None if uvs is None else uvs.astype(np.float32),
                    colors=None if colors is None else colors.astype(np.float32),
                    material=material,
                    name=str(prim.GetName()),
                )
            )
        return meshes


def _skin_of(skin: Skin | None, told: NDArray | None) -> Skin | None:
    """The influences of vertices: those of the points whose numbers (V, 1) are told, or what is
    left of refined weights (V, J)."""
    if told is None:
        return None
    return refined_influences(told) if skin is None else skin.take(told[:, 0].astype(np.int64))


def _facets(points: NDArray, polygons: Polygons, flipped: bool) -> tuple[NDArray, Polygons]:
    """The normals of polygons, the same for all of their corners; equal ones are one value."""
    face = np.repeat(np.arange(len(polygons.counts)), polygons.counts)
    corner = points[polygons.indices]
    first = corner[(np.cumsum(polygons.counts) - polygons.counts)[face]]
    total = np.zeros((len(polygons.counts), 3))
    accumulate(total, face, np.cross(corner - first, corner[polygons.next()] - first))
    normals = unit(-total if flipped else total).astype(np.float32)
    of_kind, index = unique_rows(rank_rows(normals))
    return normals[of_kind].astype(np.float64), Polygons(polygons.counts, index[face])


def _expand(
    value: Any, how: str, polygons: Polygons, width: int
) -> tuple[NDArray, Polygons] | None:
    """A primvar as (values (N, width), faces into them); None when its size does not fit its
    interpolation."""
    v = np.array(value, np.float64)
    if v.size % width:
        return None
    v = v.reshape(-1, width)
    corners = len(polygons.indices)
    if how in ("vertex", "varying") and len(v) > polygons.indices.max(initial=-1):
        return v, polygons
    if how == "constant" and len(v):
        return v[:1], Polygons(polygons.counts, np.zeros(corners, np.int64))
    if how == "uniform" and len(v) == len(polygons.counts):
        return v, Polygons(polygons.counts, np.repeat(np.arange(len(v)), polygons.counts))
    if how == "faceVarying" and len(v) == corners:
        # corners of one point with one value are one vertex: seams are where values differ
        used, index = unique_rows(np.concatenate([polygons.indices[:, None], rank_rows(v)], axis=1))
        return v[used], Polygons(polygons.counts, index)
    return None


def _text(get: Callable[[], str]) -> str:
    """What USD says, in one line, without the names of its own functions. It may quote bytes that
    are no text."""
    try:
        return re.sub(r"pxrInternal\w*::(?:\w+::)*", "", " ".join(get().split()))[:200]
    except UnicodeDecodeError:
        return "it is not text"
