"""The pool of reference views: what each iteration sees, and how long."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from appearance_opt.reference.pool import FIRST, ReferencePool
from appearance_opt.views import Views, ViewSampler

SAMPLER = ViewSampler((0.0, 0.0, 0.0), 1.0, seed=3)
CAPACITY, BATCH = 12, 3


class Counting:
    """A black box that remembers how many views it was asked for; each image tells its view's
    light."""

    def __init__(self) -> None:
        self.rendered = 0

    def render(self, views: Views, resolution: int, samples: int = 16) -> np.ndarray:
        self.rendered += len(views)
        image = np.zeros((len(views), resolution, resolution, 4), np.float32)
        image[..., 0] = np.abs(np.array(views.records()).reshape(len(views), -1)[:, 3])[
            :, None, None
        ]
        return image


def pool_of(reuse: int) -> ReferencePool:
    return ReferencePool(Counting(), SAMPLER, CAPACITY, BATCH, 4, 1, reuse=reuse)


def seen(pool: ReferencePool, iterations: range) -> list[tuple]:
    """The views of each iteration, as something that can be compared and counted."""
    return [
        tuple(map(tuple, np.array(pool.draw(i)[0].records()).reshape(BATCH, -1)))
        for i in iterations
    ]


@pytest.mark.parametrize("reuse", [1, 2, 4])
def test_views_are_seen_as_often_as_asked(reuse: int) -> None:
    pool, iterations = pool_of(reuse), 400
    counts = Counter(view for batch in seen(pool, range(iterations)) for view in batch)
    assert np.mean(list(counts.values())) == pytest.approx(reuse, rel=0.1)
    assert pool.reference.rendered == pytest.approx(iterations * BATCH / reuse, rel=0.1)
    assert len(pool._images) <= CAPACITY


def test_a_large_pool_is_not_filled_before_its_views_are_used() -> None:
    pool = ReferencePool(Counting(), SAMPLER, 40 * BATCH, BATCH, 4, 1, reuse=4)
    rendered = []
    for batch in range(200):
        pool.draw(batch)
        rendered.append(pool.reference.rendered // BATCH)
    assert rendered[:FIRST] == list(range(1, FIRST + 1))
    assert rendered[-1] == FIRST + (200 - FIRST) // 4
    assert len(pool._images) == 40 * BATCH


def test_views_stay_if_asked() -> None:
    pool = pool_of(0)
    views = {view for batch in seen(pool, range(100)) for view in batch}
    assert len(views) == pool.reference.rendered == CAPACITY


def test_a_new_view_replaces_the_oldest() -> None:
    pool = pool_of(2)
    batches = seen(pool, range(200))
    last = {view: k for k, batch in enumerate(batches) for view in batch}
    first = {view: k for k, batch in reversed(list(enumerate(batches))) for view in batch}
    lifetime = 2 * CAPACITY // BATCH
    assert max(last[v] - first[v] for v in last) < lifetime


@pytest.mark.parametrize("start", [2, 9, 57])
def test_a_resumed_fit_sees_the_same_views_and_images(start: int) -> None:
    whole, resumed = pool_of(2), pool_of(2)
    for i in range(start):
        whole.draw(i)
    for i in range(start, start + 12):
        (views, targets), (again, images) = whole.draw(i), resumed.draw(i)
        np.testing.assert_array_equal(np.array(views.records()), np.array(again.records()))
        np.testing.assert_array_equal(np.array(targets.average), np.array(images.average))


def test_images_belong_to_their_views() -> None:
    pool = pool_of(3)
    for i in range(30):
        views, targets = pool.draw(i)
        light = np.abs(np.array(views.records()).reshape(BATCH, -1)[:, 3])
        red = np.array(targets.average).reshape(BATCH, 16, 4)[:, 0, 0]
        np.testing.assert_allclose(red, light, rtol=1e-3)
