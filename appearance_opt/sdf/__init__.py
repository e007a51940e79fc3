"""Distance fields: shapes as functions of position, and what they are put together from.

A user's file imports this package alone (``from appearance_opt import sdf``) and hands out a
``Shape``. All functions take and return Dr.Jit arrays.
"""

from appearance_opt.sdf.shape import Material, Shape

__all__ = ["Material", "Shape"]
