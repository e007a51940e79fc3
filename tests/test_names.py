"""What options offer is what the packages below them have: ``options`` imports none of them,
to start fast."""

from __future__ import annotations

from appearance_opt.latent.subdivision import MAX_LEVEL
from appearance_opt.optimize.losses import LOSSES
from appearance_opt.optimize.plan import FIXED_BACKGROUNDS
from appearance_opt.options.fitting import LOSS_NAMES
from appearance_opt.options.maps import MAX_SUBDIVISION
from appearance_opt.options.views import BACKGROUNDS


def test_options_offer_what_there_is() -> None:
    assert tuple(LOSSES) == LOSS_NAMES
    assert {"random", *FIXED_BACKGROUNDS} == set(BACKGROUNDS)
    assert MAX_LEVEL == MAX_SUBDIVISION
