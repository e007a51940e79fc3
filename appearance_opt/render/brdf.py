"""Surface reflection: Lambert plus isotropic GGX under one point light.

The formulas are those of glTF 2.0, appendix B (Schlick Fresnel, height-correlated Smith), so that
what the fit sees is what engines show. Specular colour k_s = (1 - m) 0.04 + m k_d, without the
attenuation of Hasselgren et al. 2021, section 3, which no file format has.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from appearance_opt.render.math import at_least, clamp, unit

ROUGHNESS_FLOOR = 0.08
"""Smallest roughness (GGX alpha = roughness^2), after the paper: below it a highlight of a point
light is smaller than a pixel and its gradient useless."""


GRAZING_COSINE = 0.02  # docs/trials.md: silhouettes
"""Masking takes no flatter angles of light and viewer than this. Where both graze the surface, the
highlight goes to zero within a range of angles as narrow as that: the few rays that meet a narrower
one have derivatives that drown all others."""


@dataclass
class MaterialSample:
    """Material at each sample. ``base_color``: linear. ``normal``: tangent-space normal, not
    normalised, or None without a normal map. ``unlit``: shown in its base colour: by
    sample, or True for all of them."""

    base_color: mi.Color3f
    roughness: mi.Float
    metalness: mi.Float
    normal: mi.Vector3f | None = None
    unlit: mi.Bool | bool = False


def reflect(material: MaterialSample, n: mi.Vector3f, v: mi.Vector3f, l: mi.Vector3f) -> mi.Color3f:  # noqa: E741
    """Return the BRDF times the cosine of the light, for unit shading normal n, directions to
    viewer v and light l.

    Zero where the light is below the shading horizon. Reflectance per steradian (linear RGB).
    """
    alpha = dr.square(at_least(material.roughness, ROUGHNESS_FLOOR))
    alpha2 = dr.square(alpha)
    f0 = dr.fma(material.metalness, material.base_color - 0.04, mi.Color3f(0.04))
    diffuse = material.base_color * ((1 - material.metalness) * dr.inv_pi)
    h = unit(l + v)  # zero where the light is exactly behind: n.l is then below zero
    nl = dr.dot(n, l)
    masked, nv = (at_least(x, GRAZING_COSINE) for x in (nl, dr.dot(n, v)))
    nh = clamp(dr.dot(n, h), 0, 1)
    vh = clamp(dr.dot(v, h), 0, 1)
    # (n.h)^2 (alpha^2 - 1) + 1 with the sine from the cross product: near the mirror direction of
    # smooth surfaces 1 - (n.h)^2 has lost its digits
    denominator = dr.fma(dr.square(nh), alpha2, dr.squared_norm(dr.cross(n, h)))
    # of unit vectors it is never below alpha^2; n and h can be zero where normals cancel
    denominator = at_least(denominator, 0.5 * alpha2)
    distribution = alpha2 * dr.inv_pi / dr.square(denominator)
    smith = masked * dr.sqrt(dr.fma(dr.square(nv), 1 - alpha2, alpha2))
    smith += nv * dr.sqrt(dr.fma(dr.square(masked), 1 - alpha2, alpha2))
    visibility = 0.5 / smith
    c = 1 - vh
    fresnel = dr.fma(1 - f0, dr.square(dr.square(c)) * c, f0)
    return (dr.fma(-fresnel, diffuse, diffuse) + fresnel * (distribution * visibility)) * at_least(
        nl, 0
    )
