"""How a fit is set up, and the levers: one change each against the product's own setting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from appearance_opt.config import simplify_options
from appearance_opt.latent.parameter import Rates
from appearance_opt.optimize.plan import FitOptions
from appearance_opt.options.views import ViewOptions
from appearance_opt.render.boundary.camera_rays import CameraRays
from appearance_opt.render.boundary.edges import Edges
from appearance_opt.render.quality import Quality
from appearance_opt.stages import fitting, growth


@dataclass(frozen=True)
class Setup:
    """Everything that a lever can move. ``point_width``: None follows the product's rule.
    ``rates``: None follows the product's rule for the start. ``smoothing``: strength of
    preconditioned steps of the positions, with ``smooth_rate`` in units of the object's radius; 0
    for plain Adam. ``coarse``: until which part of the fit, at which resolution, before
    ``resolution``. ``decimated``: as opposed to a sphere that is grown. ``closed_form``: maps
    transferred from the reference rather than constant."""

    resolution: int
    views: int
    pool: int
    texture: int
    decimated: bool
    pool_samples: int = fitting.POOL_SAMPLES
    reuse: int = ViewOptions.reuse
    point_width: float | None = None
    rates: Rates | None = None
    rate_factor: float = 1.0
    decay: float = FitOptions.decay
    quality: Quality = field(default_factory=Quality)
    loss: str = FitOptions.loss
    laplacian: float = 0.0
    relative: bool = True
    laplacian_decays: bool = True
    smoothing: float = 0.0
    smooth_rate: float = 0.0
    coarse: tuple[float, int] | None = None
    mip: bool = True
    closed_form: bool = True
    seed: int = 0

    def width(self, resolution: int) -> float:
        """Filter width of point samples, in pixels."""
        return (
            fitting.point_width(resolution, self.texture)
            if self.point_width is None
            else self.point_width
        )


def default_setup(grown: bool, triangles: int) -> Setup:
    """What the product does: the preset ``default`` from a decimated mesh, or the growing of a
    sphere of ``triangles``."""
    if grown:
        strength, rate = growth.smoothing(triangles)
        return Setup(
            growth.RESOLUTION, growth.VIEWS, growth.POOL, growth.TEXTURE, False,
            pool_samples=growth.POOL_SAMPLES, point_width=growth.POINT_WIDTH, rates=growth.RATES, decay=1.0,
            relative=False, smoothing=strength, smooth_rate=rate,
        )  # fmt: skip
    o = simplify_options("default", ratio=1.0)
    return Setup(
        o.views.resolution,
        o.views.per_step,
        o.views.pool,
        o.texture.size,
        True,
        laplacian=o.fit.laplacian,
    )


@dataclass(frozen=True)
class Lever:
    """One change. ``group``: the panel it is drawn in. ``change`` returns None where it means
    nothing. ``core``: part of the published run; the others are there to be asked for by name."""

    name: str
    group: str
    change: Callable[[Setup], Setup | None]
    core: bool = True


DEFAULT, SEED, UNAVERAGED = "default", "another seed", "no averaging"
"""The second tells what chance does. The third is no fit of its own: the last parameters of the
default's fit rather than their running mean."""


def _resolution(factor: float) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, resolution=round(factor * s.resolution))


def _wider(factor: float) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, point_width=factor * s.width(s.resolution))


def _views(factor: float) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, views=round(factor * s.views))


def _texture(factor: float) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, texture=round(factor * s.texture))


def _quality(density: float, rays: int) -> Callable[[Setup], Setup]:
    visibility = CameraRays((Edges(density),) if density else (), rays)
    return lambda s: replace(s, quality=Quality(visibility=visibility))


def _reuse(times: int) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, reuse=times)


def _loss(name: str) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, loss=name)


def _rates(factor: float) -> Callable[[Setup], Setup]:
    return lambda s: replace(s, rate_factor=factor)


def _laplacian(factor: float) -> Callable[[Setup], Setup | None]:
    return lambda s: replace(s, laplacian=factor * s.laplacian) if s.laplacian else None


def _absolute(s: Setup) -> Setup:
    return replace(s, relative=False, laplacian=s.laplacian or FIRST_LAPLACIAN)


def _large_steps(rate: float) -> Callable[[Setup], Setup | None]:
    # smoothing takes the regularizer's place, as in the paper and as in growing
    return lambda s: (
        replace(s, smoothing=1.0, smooth_rate=rate, laplacian=0.0) if s.decimated else None
    )


def _plain_adam(s: Setup) -> Setup | None:
    if s.decimated:
        return None
    rates = fitting.fit_policy(0.0, False)[1]
    return replace(s, smoothing=0.0, rates=rates, laplacian=FIRST_LAPLACIAN, relative=False)


FIRST_LAPLACIAN = simplify_options("default", ratio=1.0).fit.laplacian
"""Weight where the default has none: that of decimated starts."""

LEVERS = (
    Lever(DEFAULT, "noise and averaging", lambda s: s),
    Lever(SEED, "noise and averaging", lambda s: replace(s, seed=1)),
    Lever("resolution x 1/2", "resolution", _resolution(0.5)),
    Lever("resolution x 3/4", "resolution", _resolution(0.75), core=False),
    Lever("resolution x 3/2", "resolution", _resolution(1.5)),
    Lever(
        "half resolution for 30 %",
        "resolution",
        lambda s: replace(s, coarse=(0.3, s.resolution // 2)),
    ),
    Lever("views x 1/2", "views per step", _views(0.5)),
    Lever("views x 2", "views per step", _views(2.0)),
    Lever("pool x 2/5", "views per step", lambda s: replace(s, pool=2 * s.pool // 5), core=False),
    Lever("views stay", "reference", _reuse(0), core=False),
    Lever("views seen 8 times", "reference", _reuse(8), core=False),
    Lever("views seen twice", "reference", _reuse(2), core=False),
    Lever("views seen once", "reference", _reuse(1), core=False),
    Lever("4 rays at its outlines", "reference", lambda s: replace(s, pool_samples=4), core=False),
    Lever(
        "32 rays at its outlines", "reference", lambda s: replace(s, pool_samples=32), core=False
    ),
    Lever("points 2/5 as wide", "reference", _wider(0.4), core=False),
    Lever("no silhouette gradient", "visibility", _quality(0.0, 1)),
    Lever("4 rays at silhouettes", "visibility", _quality(1.0, 4)),
    Lever("16 rays at silhouettes", "visibility", _quality(1.0, 16)),
    Lever("4 silhouette points, 16 rays", "visibility", _quality(4.0, 16), core=False),
    Lever("no mip mapping", "mip mapping and start", lambda s: replace(s, mip=False)),
    Lever(
        "constant textures",
        "mip mapping and start",
        lambda s: replace(s, closed_form=False) if s.decimated else None,
    ),
    Lever("Laplacian 0", "Laplacian", _laplacian(0.0)),
    Lever("Laplacian x 4", "Laplacian", _laplacian(4.0)),
    Lever("absolute Laplacian", "Laplacian", _absolute),
    Lever(
        "Laplacian without decay",
        "Laplacian",
        lambda s: replace(s, laplacian_decays=False) if s.laplacian else None,
        core=False,
    ),
    Lever("preconditioned, rate 0.02", "vertex steps", _large_steps(0.02)),
    Lever("preconditioned, rate 0.1", "vertex steps", _large_steps(0.1)),
    Lever("plain Adam", "vertex steps", _plain_adam),
    Lever("rates x 1/2", "learning rates", _rates(0.5)),
    Lever("rates x 2", "learning rates", _rates(2.0)),
    Lever("rates without decay", "learning rates", lambda s: replace(s, decay=0.0), core=False),
    Lever("texture x 1/2", "texture size", _texture(0.5)),
    Lever("texture x 2", "texture size", _texture(2.0)),
    Lever("loss l1", "loss", _loss("l1")),
    Lever("loss log-srgb-l2", "loss", _loss("log-srgb-l2"), core=False),
    Lever("loss l2", "loss", _loss("l2"), core=False),
    Lever("loss smape", "loss", _loss("smape"), core=False),
    Lever("loss relative-l2", "loss", _loss("relative-l2"), core=False),
)

GROUPS = {DEFAULT: LEVERS[0].group, UNAVERAGED: LEVERS[0].group} | {
    lever.name: lever.group for lever in LEVERS
}
"""Lever -> group, in the order of tables and pictures."""
