"""What options offer is what the packages below them have: ``config`` imports none of them, to
start fast."""

from __future__ import annotations

from appearance_opt import config
from appearance_opt.fit.loop import FIXED_BACKGROUNDS
from appearance_opt.fit.losses import LOSSES
from appearance_opt.latent.subdivision import MAX_LEVEL


def test_options_offer_what_there_is() -> None:
    assert tuple(LOSSES) == config.LOSS_NAMES
    assert {"random", *FIXED_BACKGROUNDS} == set(config.BACKGROUNDS)
    assert MAX_LEVEL == config.MAX_SUBDIVISION
