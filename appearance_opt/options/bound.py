"""How much a result may differ from its source."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from appearance_opt.errors import InputError

SMALLEST, LARGEST = 4, 8192
"""Sizes on screen, in pixels."""

_KINDS = {"px": "silhouette_shift", "flip": "flip", "psnr": "psnr_covered"}


@dataclass(frozen=True)
class Bound:
    """``metric``: a field of ``evaluate.metrics.ViewMetrics``; ``value``: what it may be at the
    most (PSNR: at the least, dB)."""

    metric: str
    value: float

    @property
    def limit(self) -> float:
        """The value as an error: see ``error``."""
        return self.error(self.value)

    def error(self, measured: float) -> float:
        """A measured value as an error, of which less is better, and which is near a power of the
        number of triangles: PSNR becomes the root of the mean squared error."""
        return float(10.0 ** (-measured / 20.0)) if self.metric == "psnr_covered" else measured

    def value_of(self, error: float) -> float:
        """The reverse of ``error``."""
        import math

        if self.metric != "psnr_covered":
            return error
        return -20.0 * math.log10(max(error, 1e-5))

    def show(self, value: float) -> str:
        """A value of the metric in words."""
        unit = {"silhouette_shift": "{:.3g} px", "flip": "FLIP {:.3g}", "psnr_covered": "{:.2f} dB"}
        return unit[self.metric].format(value)


def parse_bound(text: Any) -> Bound:
    """Of "0.5px" (silhouettes shift by so many pixels), "flip=0.02" or "psnr=35" (dB, of covered
    pixels). Raises InputError."""
    match = re.fullmatch(
        r"\s*(?:(flip|psnr)\s*=\s*)?(\d+(?:\.\d*)?|\.\d+)\s*(px)?\s*",
        text if isinstance(text, str) else "",
    )
    if match is None or (match[1] is None) == (match[3] is None):
        raise InputError(f"--max-error {text}: write a bound such as 0.5px, flip=0.02 or psnr=35")
    kind, value = match[1] or "px", float(match[2])
    most = {"px": 100.0, "flip": 1.0, "psnr": 90.0}[kind]
    if not 0 < value < most:
        raise InputError(f"--max-error {text}: must be above 0 and below {most:g}")
    return Bound(_KINDS[kind], value)


def bound_text(value: Any) -> str:
    """A bound as an option keeps it: as it was written, and can be parsed. Raises InputError."""
    parse_bound(value)
    return str(value).strip()
