"""Blend shapes of USD at their default weights."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def blend_shapes(
    prim: Any, points: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """((V, 3) points, (V, 3) what is added to the normals of these points) of a mesh with blend
    shapes; None without any. Weights are those that the animation of its skeleton has apart from
    its time samples (UsdSkelAnimation, "Blend Shapes"), which are animation, and zero otherwise."""
    from pxr import UsdSkel, Vt

    binding = UsdSkel.BindingAPI(prim)
    names = binding.GetBlendShapesAttr().Get()
    if not names:
        return None
    turned = np.zeros_like(points)
    given, query = _weights(binding), UsdSkel.BlendShapeQuery(binding)
    weights = [given.get(str(name), 0.0) for name in names][: query.GetNumBlendShapes()]
    if not any(weights):
        return points, turned
    moved = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))
    of_shapes = query.ComputeSubShapeWeights(
        Vt.FloatArray(weights)
    )  # in-between shapes have their share
    indices, offsets = query.ComputeBlendShapePointIndices(), query.ComputeSubShapePointOffsets()
    query.ComputeDeformedPoints(*of_shapes, indices, offsets, moved)
    for k, weight in enumerate(weights):
        normals = query.GetBlendShape(k).GetNormalOffsetsAttr().Get()
        if weight and normals:
            turned[list(indices[k]) or slice(None)] += weight * np.array(normals, np.float64)
    return np.array(moved, np.float64), turned


def shape_names(prim: Any) -> list[str]:
    """Names of the blend shapes of a mesh."""
    from pxr import UsdSkel

    return [str(name) for name in UsdSkel.BindingAPI(prim).GetBlendShapesAttr().Get() or []]


def _weights(binding: Any) -> dict[str, float]:
    """Default weights by the names of blend shapes."""
    from pxr import Usd, UsdSkel

    source, skeleton = binding.GetInheritedAnimationSource(), binding.GetInheritedSkeleton()
    if not source and skeleton:
        source = UsdSkel.BindingAPI(skeleton.GetPrim()).GetInheritedAnimationSource()
    if not source:
        return {}
    animation = UsdSkel.Animation(source)
    names = animation.GetBlendShapesAttr().Get() or []
    values = animation.GetBlendShapeWeightsAttr().Get(Usd.TimeCode.Default()) or []
    return {str(n): float(v) for n, v in zip(names, values, strict=False)}
