"""The cameras and lights of ``appearance-opt compare``, for other engines; and their pictures."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from appearance_opt import backend
from appearance_opt.asset.types import srgb_to_linear
from appearance_opt.placement import Placement
from appearance_opt.views import MEASURED, Views, views_around

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from appearance_opt.asset.types import Asset


@dataclass(frozen=True)
class Sitting:
    """Views around an asset: ``views`` in local coordinates, ``placement``: where these lie in the
    world."""

    views: Views
    placement: Placement

    @classmethod
    def of(cls, asset: Asset, count: int, seed: int = 0) -> Sitting:
        """Framed by this asset alone, so that all candidates share the views."""
        backend.select("cpu")
        placement = Placement.around(asset.points())
        sampler = views_around(placement.to_local(asset.points()), seed).held_out(MEASURED)
        return cls(sampler.draw(0, count), placement)

    def write(self, path: Path) -> None:
        """As JSON in the world: eye, forward, up, field of view (degrees), light, radiant
        intensity."""
        v, rows = self.views, []
        for k in range(len(v)):
            half = float(np.linalg.norm(v.right[k]))
            rows.append(
                {
                    "eye": self.placement.to_world(v.eye[k]).tolist(),
                    "forward": v.forward[k].tolist(),
                    "up": (-v.down[k] / half).tolist(),
                    "fov": float(np.degrees(2 * np.arctan(half))),
                    "light": self.placement.to_world(v.light[k]).tolist(),
                    "intensity": float(v.intensity[k] * self.placement.scale**2),
                }
            )
        place = {"centre": self.placement.centre, "radius": self.placement.scale}
        path.write_text(json.dumps({**place, "views": rows}, indent=1))


def own_images(sitting: Sitting, asset: Asset, resolution: int) -> NDArray[np.float32]:
    """(B, H, W, 4) images of our own renderer."""
    from appearance_opt.evaluate.comparison import render_asset

    return render_asset(sitting.placement.local(asset), sitting.views, resolution, 16)


def read_pictures(folder: Path, name: str, count: int, shrink: int = 1) -> NDArray[np.float32]:
    """``folder``/``name``_k.png (RGBA, sRGB, alpha not premultiplied) as (B, H, W, 4) premultiplied
    linear radiance and coverage; ``shrink`` x ``shrink`` pixels averaged."""
    from PIL import Image

    out = []
    for k in range(count):
        with Image.open(folder / f"{name}_{k}.png") as file:
            a = np.asarray(file.convert("RGBA"), np.float32) / 255
        a = np.concatenate([srgb_to_linear(a[..., :3]) * a[..., 3:], a[..., 3:]], axis=-1)
        h, w = (n // shrink for n in a.shape[:2])
        out.append(a.reshape(h, shrink, w, shrink, 4).mean((1, 3)))
    return np.stack(out)


def write_sheet(path: Path, reference: NDArray, candidate: NDArray) -> None:
    """A picture: per view the reference, the candidate, and four times their difference."""
    from PIL import Image

    from appearance_opt.render.display import display

    a, b = (np.concatenate(list(display(x)), axis=0) for x in (reference, candidate))
    sheet = np.concatenate([a, b, np.clip(4 * np.abs(a - b), 0, 1)], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((sheet * 255 + 0.5).astype(np.uint8)).save(path)
