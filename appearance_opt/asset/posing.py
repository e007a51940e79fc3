"""Where the nodes, bones and vertices of a rigged asset are at a time, in double precision."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt.asset.instances import Instances, place_copies
from appearance_opt.asset.rig import REST
from appearance_opt.asset.transforms import compose, normalized, slerp

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from appearance_opt.asset.rig import Channel, Clip, Rig, Skin, TargetPath
    from appearance_opt.asset.types import Asset, Mesh


def sample(channel: Channel, times: Sequence[float] | NDArray) -> NDArray[np.float64]:
    """(T, W) values of a channel at ``times`` (T,), seconds (glTF 2.0, appendix C)."""
    at = np.clip(np.asarray(times, np.float64), channel.times[0], channel.times[-1])
    keys = channel.times
    last = np.clip(np.searchsorted(keys, at, side="right") - 1, 0, len(keys) - 1)
    following = np.minimum(last + 1, len(keys) - 1)
    step = keys[following] - keys[last]
    share = np.where(step > 0, (at - keys[last]) / np.where(step > 0, step, 1.0), 0.0)
    values, turns = channel.values, channel.path == "rotation"
    if channel.interpolation == "STEP":
        return values[last]
    if channel.interpolation == "CUBICSPLINE":
        t, d = share[:, None], step[:, None]
        out = (
            (2 * t**3 - 3 * t**2 + 1) * values[last, 1]
            + d * (t**3 - 2 * t**2 + t) * values[last, 2]
            + (3 * t**2 - 2 * t**3) * values[following, 1]
            + d * (t**3 - t**2) * values[following, 0]
        )
        return normalized(out) if turns else out
    if turns:
        return slerp(values[last], values[following], share)
    return values[last] + share[:, None] * (values[following] - values[last])


def node_matrices(
    rig: Rig, clip: Clip | None, times: Sequence[float] | NDArray
) -> NDArray[np.float64]:
    """(T, N, 4, 4) from the coordinates of each node to the world at ``times`` (T,), seconds of a
    clip; at rest without one."""
    at = np.atleast_1d(np.asarray(times, np.float64))
    moving: dict[int, dict[TargetPath, NDArray]] = {}
    for channel in () if clip is None else clip.channels:
        moving.setdefault(channel.node, {})[channel.path] = sample(channel, at)
    out = np.empty((len(at), len(rig.nodes), 4, 4))
    for k, node in enumerate(rig.nodes):
        if k not in moving and node.matrix is not None:
            local = node.matrix
        else:
            own = moving.get(k, {})
            local = compose(*(own.get(path, np.array(getattr(node, path))) for path in REST))
        out[:, k] = local if node.parent < 0 else out[:, node.parent] @ local
    return out


def bone_matrices(
    rig: Rig, clip: Clip | None, times: Sequence[float] | NDArray
) -> NDArray[np.float64]:
    """(T, B, 4, 4) from bind space to the world for each bone (``M_b`` of Hasselgren et al. 2021,
    eq. 2) at ``times`` (T,), seconds of a clip; at rest without one."""
    return node_matrices(rig, clip, times)[:, rig.bone_nodes] @ rig.inverse_bind


def pose(asset: Asset, clip: str | None, time: float) -> NDArray[np.float64]:
    """(B, 4, 4) bone matrices of an asset at a time of a clip, seconds; at rest without one. Raises
    InputError for a clip that does not exist."""
    assert asset.rig is not None, "assets without a rig have no pose"
    chosen = None if clip is None else asset.rig.clip(clip)
    return bone_matrices(asset.rig, chosen, [time])[0]


def blend(skin: Skin, matrices: NDArray) -> NDArray[np.float64]:
    """(V, 4, 4) blended bone matrices (B, 4, 4) of each vertex."""
    flat = matrices[:, :3].reshape(len(matrices), 12)
    out = np.zeros((len(skin.bones), 12))
    for k in range(skin.bones.shape[1]):
        out += skin.weights[:, k, None].astype(np.float64) * flat[skin.bones[:, k]]
    whole = np.zeros((len(out), 4, 4))
    whole[:, :3] = out.reshape(-1, 3, 4)
    whole[:, 3, 3] = skin.weights.sum(axis=1, dtype=np.float64)
    return whole


def pose_positions(mesh: Mesh, matrices: NDArray) -> NDArray[np.float64]:
    """(V, 3) vertices of a mesh under bone matrices (B, 4, 4), in the world."""
    p = mesh.positions.astype(np.float64)
    return p if mesh.skin is None else Instances(blend(mesh.skin, matrices), True).points(p)


def pose_mesh(mesh: Mesh, matrices: NDArray) -> Mesh:
    """A mesh under bone matrices (B, 4, 4), in the world, without its skin. Normals are transformed
    by the inverse transpose of what moves their vertex."""
    if mesh.skin is None:
        return mesh
    moved = place_copies(mesh, Instances(blend(mesh.skin, matrices), skinned=True), mesh.name)
    return replace(moved, positions=moved.positions.astype(np.float32), skin=None)


def pose_asset(asset: Asset, clip: str | None, time: float) -> Asset:
    """The asset as it stands at a time of a clip, seconds; at rest without one: meshes alone,
    without a rig. Raises InputError for a clip that does not exist."""
    if asset.rig is None:
        return asset
    matrices = pose(asset, clip, time)
    return replace(asset, meshes=tuple(pose_mesh(m, matrices) for m in asset.meshes), rig=None)
