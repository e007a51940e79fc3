"""What moves a character: a hierarchy of nodes, the bones of its skins, and clips of animation.

A bone is a node and an inverse bind matrix. A mesh with a ``Skin`` has its positions in the common
bind space of the asset (metres, +Y up); at a time t of a clip vertex v is at

    sum over its influences of weight * world(node, t) * inverse_bind * v

(glTF 2.0, 3.7.3; UsdSkel, "Skinning a Point"). What hangs rigidly on a node has one bone.
Everything here is in double precision, column vectors, quaternions (x, y, z, w).
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from appearance_opt.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

TargetPath = Literal["translation", "rotation", "scale"]
Interpolation = Literal["LINEAR", "STEP", "CUBICSPLINE"]

REST: dict[TargetPath, tuple[float, ...]] = {
    "translation": (0.0, 0.0, 0.0),
    "rotation": (0.0, 0.0, 0.0, 1.0),
    "scale": (1.0, 1.0, 1.0),
}
"""What channels move, and the values that move nothing."""

DEFAULT_RATE = 24.0
"""Frames per second where nothing tells."""


@dataclass(frozen=True)
class Skin:
    """Influences of the vertices of a mesh: ``bones`` (V, K) int32, numbers among the bones of the
    rig; ``weights`` (V, K) float32, not negative, of sum one. Unused places have weight 0."""

    bones: NDArray[np.int32]
    weights: NDArray[np.float32]

    def take(self, vertices: NDArray) -> Skin:
        """That of some vertices, in any order."""
        return Skin(self.bones[vertices], self.weights[vertices])

    @property
    def rigid(self) -> bool:
        """Does everything hang on one bone, as a part without a skin does?"""
        return self.bones.shape[1] == 1 and bool((self.bones == self.bones[:1]).all())


@dataclass(frozen=True)
class Joint:
    """A joint, or any other node of the hierarchy. ``parent``: number of a node before it, -1 at
    the top. Its transform at rest relative to the parent is translation * rotation * scale, or
    ``matrix`` (4, 4) if these cannot say it. ``extras``: JSON value of the file."""

    name: str
    parent: int = -1
    translation: tuple[float, ...] = REST["translation"]
    rotation: tuple[float, ...] = REST["rotation"]
    scale: tuple[float, ...] = REST["scale"]
    matrix: NDArray[np.float64] | None = None
    extras: Any = None


@dataclass(frozen=True)
class Channel:
    """One part of one node's transform over time. ``times`` (T,) seconds, in order; ``values`` (T,
    W), or (T, 3, W) of in-tangent, value and out-tangent for CUBICSPLINE (glTF 2.0, appendix C).
    Before its first and after its last key it stands still."""

    node: int
    path: TargetPath
    times: NDArray[np.float64]
    values: NDArray[np.float64]
    interpolation: Interpolation = "LINEAR"


@dataclass(frozen=True)
class Clip:
    """An animation. ``extras``: JSON value of the file."""

    name: str
    channels: tuple[Channel, ...] = ()
    extras: Any = None

    @property
    def start(self) -> float:
        """Seconds at its first key."""
        return min((float(c.times[0]) for c in self.channels), default=0.0)

    @property
    def end(self) -> float:
        """Seconds at its last key."""
        return max((float(c.times[-1]) for c in self.channels), default=0.0)

    @property
    def duration(self) -> float:
        """Seconds from its first to its last key."""
        return self.end - self.start

    @property
    def keys(self) -> int:
        """Different times at which any channel has a key."""
        every = [c.times for c in self.channels]
        return len(np.unique(np.concatenate(every))) if every else 0


@dataclass(frozen=True)
class Rig:
    """``nodes``: parents before children; ``bone_nodes`` (B,): node of each bone; ``inverse_bind``
    (B, 4, 4): from bind space to the node's own coordinates; ``rate``: frames per second by which
    frames are counted, frame 0 at 0 seconds."""

    nodes: tuple[Joint, ...]
    bone_nodes: NDArray[np.int32]
    inverse_bind: NDArray[np.float64]
    clips: tuple[Clip, ...] = ()
    rate: float = DEFAULT_RATE

    def clip(self, name: str) -> Clip:
        """The clip of that name. Raises InputError, which suggests the nearest."""
        for clip in self.clips:
            if clip.name == name:
                return clip
        names = [clip.name for clip in self.clips]
        if not names:
            raise InputError(f"there is no clip '{name}': the asset has no animation")
        near = difflib.get_close_matches(name.lower(), [n.lower() for n in names], 1, 0.4)
        meant = [n for n in names if near and n.lower() == near[0]]
        hint = f"did you mean '{meant[0]}'? " if meant else ""
        listed = ", ".join(f"'{n}'" for n in names[:8])
        more = f" and {len(names) - 8} more" if len(names) > 8 else ""
        raise InputError(f"there is no clip '{name}'; {hint}there are {listed}{more}")


def check_keys(times: NDArray, values: NDArray, clip: str, node: str, source: str) -> None:
    """Raise InputError if the keys of a channel are none, out of order or no numbers."""
    where = f"{source}: clip '{clip}', node '{node}'"
    if not len(times):
        raise InputError(f"{where}: its animation has no keys; export it again")
    if not (np.isfinite(times).all() and np.isfinite(values).all()):
        raise InputError(f"{where}: keys are NaN or infinite; export it again")
    if (np.diff(times) < 0).any():
        raise InputError(f"{where}: its keys are out of order; export it again")


def estimate_rate(clips: tuple[Clip, ...]) -> float:
    """Frames per second at which most channels have their keys, whole where it is nearly that;
    ``DEFAULT_RATE`` where there are too few to tell."""
    steps = [np.diff(c.times) for clip in clips for c in clip.channels if len(c.times) > 2]
    between = np.concatenate(steps) if steps else np.empty(0)
    between = between[between > 1e-4]
    if not len(between):
        return DEFAULT_RATE
    rate = float(1 / np.median(between))
    whole = round(rate)
    rate = float(whole) if abs(rate - whole) < 0.02 * rate else rate
    return rate if 1 <= rate <= 240 else DEFAULT_RATE


class Bones:
    """Collects the bones of a rig in one bind space: skins may have different inverse bind matrices
    for the same node, as their meshes have coordinates of their own."""

    def __init__(self) -> None:
        self.nodes: list[int] = []
        self.inverse: list[NDArray[np.float64]] = []
        self._of: dict[int, list[int]] = {}

    def bind(self, node: int) -> NDArray[np.float64] | None:
        """(4, 4) from the coordinates of a node to bind space; None if it has no bone that could tell."""
        known = [self.inverse[bone] for bone in self._of.get(node, [])]
        found = [m for m in known if usable(m[None])[0]]
        return np.asarray(np.linalg.inv(found[0]), np.float64) if found else None

    def add(self, node: int, inverse: NDArray) -> int:
        """Number of the bone of that node and inverse bind matrix (4, 4)."""
        for bone in self._of.setdefault(node, []):
            known = self.inverse[bone]
            if np.abs(known - inverse).max() <= SAME * np.abs(known).max():
                return bone
        self._of[node].append(len(self.nodes))
        self.nodes.append(node)
        self.inverse.append(np.asarray(inverse, np.float64))
        return len(self.nodes) - 1

    def arrays(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """(nodes (B,), inverse bind matrices (B, 4, 4))."""
        return np.array(self.nodes, np.int32), np.array(self.inverse).reshape(-1, 4, 4)


SAME = 1e-6
"""Difference, relative to the largest entry, up to which inverse bind matrices are one: a step or
two of the single precision in which files have them."""


def usable(inverse: NDArray) -> NDArray[np.bool_]:
    """(N,) which matrices (N, 4, 4) are finite and can be inverted?"""
    finite = np.isfinite(inverse).all(axis=(1, 2))
    linear = np.where(finite[:, None, None], inverse[:, :3, :3], 0.0)
    size = np.abs(linear).max(axis=(1, 2), initial=1e-300)
    scaled = linear / np.maximum(size, 1e-300)[:, None, None]
    return finite & (np.linalg.svd(scaled, compute_uv=False)[:, -1] > 1e-9)
