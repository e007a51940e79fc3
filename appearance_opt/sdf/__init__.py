"""Distance fields: shapes as functions of position, and what they are put together from.

A user's file imports this package alone (``from appearance_opt import sdf``) and hands out a
``Shape``. All functions take and return Dr.Jit arrays of ``llvm_ad_rgb`` or ``cuda_ad_rgb``.
"""

from appearance_opt.sdf.noise import fractal_noise, noise
from appearance_opt.sdf.operations import (
    difference,
    elongate,
    intersection,
    mirror,
    mix,
    onion,
    repeat,
    rotate,
    round_off,
    scale,
    share,
    smooth_difference,
    smooth_intersection,
    smooth_union,
    step,
    translate,
    twist,
    union,
)
from appearance_opt.sdf.primitives import (
    box,
    capsule,
    cone,
    cylinder,
    ellipsoid,
    gyroid,
    length,
    plane,
    sphere,
    torus,
)
from appearance_opt.sdf.shape import Material, Shape

__all__ = [
    "Material",
    "Shape",
    "box",
    "capsule",
    "cone",
    "cylinder",
    "difference",
    "ellipsoid",
    "elongate",
    "fractal_noise",
    "gyroid",
    "intersection",
    "length",
    "mirror",
    "mix",
    "noise",
    "onion",
    "plane",
    "repeat",
    "rotate",
    "round_off",
    "scale",
    "share",
    "smooth_difference",
    "smooth_intersection",
    "smooth_union",
    "sphere",
    "step",
    "torus",
    "translate",
    "twist",
    "union",
]
