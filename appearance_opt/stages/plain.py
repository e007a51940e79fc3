"""Maps whose variation nobody sees become numbers: a fit leaves noise in the maps of what has one
colour."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from appearance_opt.asset.packing import EMISSION
from appearance_opt.asset.types import linear_to_srgb
from appearance_opt.latent.texels import NORMALS, Texels
from appearance_opt.reference.pool import check_images
from appearance_opt.render.display import display
from appearance_opt.render.drawn import Drawn
from appearance_opt.render.layers import renderer_of
from appearance_opt.render.material import COLORS
from appearance_opt.render.pixels import Batch, Grid
from appearance_opt.views import VALIDATION

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from appearance_opt.config import CommonOptions
    from appearance_opt.latent.latent import Latent
    from appearance_opt.reference.base import Reference
    from appearance_opt.reference.subject import Subject
    from appearance_opt.stages.start import Start
    from appearance_opt.views import Sampler

Maps = dict[str, "NDArray[np.float32] | float"]

STEP = 1 / 255
"""What nobody sees: one step of 8 bits, in maps as they are stored and in pictures as they are
shown."""

NOISE = 12 * STEP
"""Deviation from their mean up to which maps may be noise (99 % of the texels): pictures decide.
What varies more is drawn for no such question."""

LOSS = 0.03  # docs/trials.md: constant-maps
"""dB that a result may lose, in the eyes of held-out views, by the colours of something that has
one colour becoming a number."""

VIEWS, SAMPLES = 8, 9

GROUPS = (COLORS, ("roughness",), ("metalness",), NORMALS, EMISSION)
"""Channels that are constant together or not at all."""


def flatten_maps(
    model: Latent,
    maps: Maps,
    start: Start,
    subject: Subject,
    options: CommonOptions,
) -> Maps:
    """The ``maps`` of a fitted model as they are to be written: see ``replace_constant``."""
    judge = (
        None
        if model.fitted(Texels) is None
        else Pictures(model, subject.reference, subject.sampler, min(options.views.resolution, 256))
    )
    return replace_constant(maps, start.known, judge, start.maps)


class Judge(Protocol):
    """What other maps change in pictures, as far as ``channels`` go."""

    channels: tuple[str, ...]

    def change(self, maps: Maps) -> float:
        """Largest difference of display values, in [0, 1], from pictures with the maps as they
        were."""
        ...

    def loss(self, maps: Maps) -> float:
        """dB by which pictures come off worse against the original's than with the maps as they
        were."""
        ...


def replace_constant(
    maps: Mapping[str, NDArray | float],
    known: NDArray[np.bool_],
    judge: Judge | None = None,
    start: Mapping[str, NDArray | float] | None = None,
) -> Maps:
    """``maps`` with numbers instead of images for every group of channels that is constant; no
    normals instead of flat ones.

    A group is constant if no texel, encoded as it is stored, lies farther than ``STEP`` from its
    mean. Pictures may tell, too, where ``judge`` draws them: if none changes by more than ``STEP``,
    by all such groups together; or, for a group that is constant in ``start``, the maps of the
    original, if they lose no more than ``LOSS``: what a fit added to it is noise. ``known`` (N, N):
    texels that belong to triangles; others do not count. Means are of linear values; of a normal
    map it is the unbent normal.
    """
    out, noisy = dict(maps), []
    for group in GROUPS:
        if not all(np.ndim(out.get(n, 0.0)) for n in group):
            continue
        numbers, off = _deviation(group, out, known)
        if off.max() <= STEP:
            out |= numbers
        elif (
            judge is not None
            and set(group) <= set(judge.channels)
            and np.quantile(off, 0.99) <= NOISE
        ):
            noisy.append((numbers, start is not None and _is_constant(group, start, known)))
    together = {n: v for numbers, _ in noisy for n, v in numbers.items()}
    trials = [(together, all(plain for _, plain in noisy)), *noisy] if len(noisy) > 1 else noisy
    for numbers, plain in trials:
        assert judge is not None
        candidate = {**out, **numbers}
        if judge.change(candidate) <= STEP or (plain and judge.loss(candidate) <= LOSS):
            out = candidate
            if numbers is together:
                break
    if not np.ndim(out.get(NORMALS[0], 0.0)):
        out = {n: v for n, v in out.items() if n not in NORMALS}
    return out


def _is_constant(
    group: Sequence[str], maps: Mapping[str, NDArray | float], known: NDArray[np.bool_]
) -> bool:
    if not all(np.ndim(maps.get(n, 0.0)) for n in group):
        return all(n in maps for n in group)
    return bool(_deviation(group, maps, known)[1].max() <= STEP)


def _deviation(
    group: Sequence[str], maps: Mapping[str, NDArray | float], known: NDArray[np.bool_]
) -> tuple[dict[str, float], NDArray[np.float32]]:
    """(the constant of each channel by name, (K,) how far the texels that count lie from it as they
    are stored)."""
    values = np.stack([np.asarray(maps[n], np.float32) for n in group], axis=-1)
    counted = known.any() and known.shape == values.shape[:2]
    seen = values[known] if counted else values.reshape(-1, len(group))
    mean = np.array([0, 0, 1]) if group == NORMALS else seen.mean(axis=0, dtype=np.float64)
    most = (
        max(float(seen.max(initial=0.0)), 1e-12) if group == EMISSION else 1.0
    )  # emission is in units of its factor
    off = np.abs(
        _stored(group, seen / most) - _stored(group, mean[None].astype(np.float32) / most)
    ).max(axis=1)
    return dict(zip(group, mean.tolist(), strict=True)), off


def _stored(group: Sequence[str], values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values (N, K) as 8 bits stand for them, from 0 to 1."""
    if group == NORMALS:
        return values * np.float32(0.5) + np.float32(0.5)
    return linear_to_srgb(np.clip(values, 0, 1)) if group in (COLORS, EMISSION) else values


class Pictures:
    """A ``Judge`` that draws a model, which has fitted maps, in views that its fit has not seen."""

    def __init__(
        self, model: Latent, reference: Reference, sampler: Sampler, resolution: int
    ) -> None:
        texels = model.fitted(Texels)
        assert texels is not None
        self._model, self._texels, self.channels = model, texels, texels.channels
        self._reference, self._resolution = reference, resolution
        self._views = sampler.held_out(VALIDATION).draw(0, VIEWS)

    @cached_property
    def _before(self) -> NDArray[np.float32]:
        return self._drawn(self._model.host_maps())

    @cached_property
    def _original(self) -> NDArray[np.float32]:
        images = self._reference.render(self._views, self._resolution, SAMPLES)
        return display(check_images(images, VIEWS, self._resolution, "held-out views"))

    def change(self, maps: Maps) -> float:
        """See ``Judge``."""
        return float(np.abs(self._drawn(maps) - self._before).max())

    def loss(self, maps: Maps) -> float:
        """See ``Judge``."""
        errors = (np.square(p - self._original).mean() for p in (self._drawn(maps), self._before))
        after, before = (max(float(e), 1e-10) for e in errors)
        return float(10 * np.log10(after / before))

    def _drawn(self, maps: Mapping[str, NDArray | float]) -> NDArray[np.float32]:
        model, batch = self._model, Batch(self._views.records(), Grid(VIEWS, self._resolution))
        codec = self._texels.codec
        decoded = {
            **model.decode(model.values()),
            self._texels.name: codec.layer(codec.encode(maps)),
        }
        shown = model.maps(decoded)
        drawn = Drawn(model.scene, model.surface(model.vertices()), shown)
        image = renderer_of(shown.coverage).render_image(drawn, batch, SAMPLES)
        return display(np.array(image).reshape(VIEWS, self._resolution, self._resolution, 4))
