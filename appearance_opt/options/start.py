"""What a simplification starts from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from appearance_opt.errors import InputError
from appearance_opt.options.bound import LARGEST, SMALLEST, bound_text
from appearance_opt.options.option import Record, check_choice, option


@dataclass(frozen=True)
class StartOptions(Record):
    """``triangles``, ``ratio`` or ``max_error``: the budget (exactly one; none is needed where
    ``init`` is a file). ``pixels``: size on screen for which the result is made, and at which its
    error is measured. ``INITS``: what ``init`` may be apart from a file."""

    INITS: ClassVar[tuple[str, ...]] = ("decimate", "sphere")

    triangles: int | None = option(
        None, "At most this many triangles.", panel="Start", low=1, expected="at least 1"
    )
    ratio: float | None = option(
        None, "Fraction of the input's triangles instead.", panel="Start", above=0, high=1
    )
    max_error: str | None = option(
        None,
        "The fewest triangles whose error is at most 0.5px (of silhouettes), flip=0.02 or psnr=35.",
        panel="Start",
        metavar="BOUND",
        parse=bound_text,
    )
    pixels: int | None = option(
        None,
        "Size on screen for which the result is made, instead of --resolution, and at which "
        "--max-error is measured.",
        panel="Start",
        low=SMALLEST,
        high=LARGEST,
        automatic="--resolution",
    )
    strict: bool = option(
        False, "End with exit code 2 if --max-error cannot be met.", panel="Start", flag="--strict"
    )
    init: str = option(
        "decimate",
        "decimate, sphere, or a file to start from.",
        panel="Start",
        metavar="decimate|sphere|FILE",
    )
    reallocate: int = option(
        1, "Rounds of moving triangles to the image error.", panel="Start", low=0, high=10
    )
    keep_hidden: bool = option(False, "Keep geometry that no outside view sees.", panel="Start")

    def __post_init__(self) -> None:
        given = (self.triangles is not None) + (self.ratio is not None)
        if self.max_error is not None and given:
            raise InputError("--max-error looks for the triangles: leave --triangles, --ratio out")
        if self.max_error is not None and self.init != "decimate":
            raise InputError(f"--max-error: works with --init decimate, not {self.init}")
        if self.strict and self.max_error is None:
            raise InputError("--strict needs --max-error BOUND")
        given += self.max_error is not None
        if given == 2 or (given == 0 and self.init in self.INITS):
            raise InputError("give either --triangles N or --ratio R, or --max-error BOUND")
        super().__post_init__()
        if self.file is None:
            check_choice("init", self.init, self.INITS)

    @property
    def file(self) -> str | None:
        """The file to start from, if ``init`` names one."""
        return self.init if self.init not in self.INITS and Path(self.init).suffix else None


@dataclass(frozen=True)
class ConvertStartOptions(StartOptions):
    """The same for what is no mesh: its first shape is found, or fitted."""

    INITS: ClassVar[tuple[str, ...]] = ("auto", "marching-cubes", "hull", "sphere")

    init: str = option(
        "auto",
        "marching-cubes (of a shape that can be asked), hull (what silhouettes leave), sphere, or "
        "a file to start from; auto: the first of them that the source allows.",
        panel="Start",
        metavar="auto|marching-cubes|hull|sphere|FILE",
    )

    def __post_init__(self) -> None:
        if self.triangles is None and self.init in self.INITS:
            raise InputError("give --triangles N")
        super().__post_init__()
