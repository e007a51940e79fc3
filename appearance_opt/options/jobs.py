"""The options of each job, composed of records, and all jobs by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from appearance_opt.errors import InputError
from appearance_opt.options.animation import AnimationOptions
from appearance_opt.options.baking import BakingOptions
from appearance_opt.options.chain import ChainOptions
from appearance_opt.options.files import OutputOptions
from appearance_opt.options.fitting import FittingOptions
from appearance_opt.options.maps import DisplacementOptions, TextureOptions
from appearance_opt.options.option import Record, option, part, require
from appearance_opt.options.parts import PartOptions
from appearance_opt.options.reading import AssetOptions
from appearance_opt.options.source import SourceOptions
from appearance_opt.options.start import ConvertStartOptions, StartOptions
from appearance_opt.options.views import ViewOptions

DEVICES = ("auto", "cpu", "cuda")
COMPARED_LIGHTS = ("point", "environment")
RENDERERS = ("own", "path")

PRESETS: dict[str, dict[str, Any]] = {
    "draft": {"budget": 19.0, "resolution": 192, "pool": 64, "reallocate": 0},
    "default": {"budget": 65.0, "resolution": 256, "reallocate": 1},
    "final": {"budget": 280.0, "resolution": 320, "reallocate": 2},
}
"""What each preset sets; everything else keeps its default. See docs/performance.md for how they
were chosen."""


def _device() -> Any:
    return option("auto", "Where to compute.", panel="Run", choices=DEVICES)


@dataclass(frozen=True)
class CommonOptions(Record):
    """What all jobs that fit are told; each offers a part of it, and has its own beside. Raises
    InputError for values that make no sense."""

    asset: AssetOptions = part(AssetOptions)
    views: ViewOptions = part(ViewOptions)
    fit: FittingOptions = part(FittingOptions)
    texture: TextureOptions = part(TextureOptions)
    displacement: DisplacementOptions = part(DisplacementOptions)
    output: OutputOptions = part(OutputOptions)
    device: str = _device()

    def levels(self) -> tuple[int, ...]:
        """Tessellation levels at which the latent is drawn, in ascending order."""
        return self.displacement.levels()


@dataclass(frozen=True)
class SimplifyOptions(CommonOptions):
    """How to simplify."""

    start: StartOptions = part(StartOptions)
    parts: PartOptions = part(PartOptions)


@dataclass(frozen=True)
class BakeOptions(CommonOptions):
    """How to bake: LOW keeps its shape, so that a fit moves normals and material alone."""

    fit: FittingOptions = part(
        FittingOptions,
        without=("laplacian", "relative", "position_rate"),
        parts=("normal", "material"),
        laplacian=0.0,
    )
    texture: TextureOptions = part(TextureOptions, only=("texture_size",))
    displacement: DisplacementOptions = part(DisplacementOptions, only=())
    baking: BakingOptions = part(BakingOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.fit.parts:
            held = name in ("normal", "material")
            require(held, "fit", name, "of normal,material: LOW keeps its shape")


@dataclass(frozen=True)
class JointOptions(CommonOptions):
    """How to fit LOW's shape, its displacement, normals and material together."""

    fit: FittingOptions = part(FittingOptions, without=("relative",), relative=True)
    texture: TextureOptions = part(TextureOptions, only=("texture_size",))
    displacement: DisplacementOptions = part(
        DisplacementOptions, without=("displacement",), fitted=True
    )
    baking: BakingOptions = part(BakingOptions, only=("samples", "cage", "unwrap", "align"))


@dataclass(frozen=True)
class AnimateOptions(SimplifyOptions):
    """How to simplify what is animated. With "shape", weights are fitted, too."""

    start: StartOptions = part(StartOptions, without=("max_error", "pixels", "strict"))
    displacement: DisplacementOptions = part(DisplacementOptions, only=())
    animation: AnimationOptions = part(AnimationOptions)


@dataclass(frozen=True)
class ConvertOptions(SimplifyOptions):
    """How to convert what is no mesh: there are no triangles to take a ratio of, no parts."""

    start: StartOptions = part(
        ConvertStartOptions, without=("ratio", "max_error", "pixels", "strict")
    )
    parts: PartOptions = part(PartOptions, only=())
    source: SourceOptions = part(SourceOptions)


@dataclass(frozen=True)
class LodOptions(SimplifyOptions):
    """How to make a chain of levels; each is fitted at the size at which it is shown."""

    start: StartOptions = part(StartOptions, only=("reallocate", "keep_hidden"), ratio=1.0)
    views: ViewOptions = part(ViewOptions, without=("resolution",))
    displacement: DisplacementOptions = part(DisplacementOptions, only=())
    chain: ChainOptions = part(ChainOptions)


@dataclass(frozen=True)
class CompareOptions(Record):
    """How to compare two assets."""

    asset: AssetOptions = part(AssetOptions)
    views: int = option(12, "Number of views.", panel="Views", low=1)
    resolution: int = option(384, "Pixels per side.", panel="Views", low=16, high=8192)
    samples: int | None = option(
        None,
        "Rays per pixel; under an environment, lights, one ray for each.",
        panel="Views",
        low=1,
        high=4096,
        automatic="16; 64 under an environment or by paths",
    )
    light: str = option(
        "point",
        "point (a lamp of its own in each view) or environment (a sky and three lamps).",
        panel="Views",
        choices=COMPARED_LIGHTS,
    )
    renderer: str = option(
        "own",
        "own (fast, no shadows) or path (Mitsuba's path tracer, its own materials, shadows).",
        panel="Views",
        choices=RENDERERS,
    )
    clip: str | None = option(
        None, "Pose both by this clip, each view at another frame.", panel="Views", metavar="NAME"
    )
    frame: float | None = option(
        None, "Frame of the clip for all views, at the rate of the reference.", panel="Views"
    )
    seed: int = option(0, "Seed of views and lights.", panel="Views", low=0)
    device: str = _device()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frame is not None and self.clip is None:
            raise InputError("--frame needs --clip NAME")


@dataclass(frozen=True)
class InspectOptions(Record):
    """How to inspect an asset."""

    asset: AssetOptions = part(AssetOptions)


@dataclass(frozen=True)
class Job:
    """A kind of job: ``help`` in a sentence, its options, what it calls its inputs, whether it
    writes anything, and ``hints``: what to write instead of keys that are no longer there. The
    recipe is the function of the kind's name in the module of ``jobs`` of that name."""

    help: str
    options: type[Record]
    inputs: tuple[str, ...]
    writes: bool = True
    hints: Mapping[str, str] = field(default_factory=dict)

    @property
    def fits(self) -> bool:
        """Does it make an asset, with progress, a report and a time budget?"""
        return issubclass(self.options, CommonOptions)


JOINT = (
    "baking with LOW's shape free is a job of its own: write appearance-opt joint HIGH LOW --out "
    "OUT, in Python appearance_opt.joint with joint_options"
)

JOBS: dict[str, Job] = {
    "simplify": Job(
        "Write an asset with fewer triangles that looks like INPUT.", SimplifyOptions, ("INPUT",)
    ),
    "bake": Job(
        "Bake what HIGH looks like into the maps of LOW, which keeps its shape.",
        BakeOptions,
        ("HIGH", "LOW"),
        hints={"joint": JOINT},
    ),
    "joint": Job(
        "Bake with LOW's shape free: fit it, a displacement, normals and material together.",
        JointOptions,
        ("HIGH", "LOW"),
    ),
    "animate": Job(
        "Write an animated character with fewer triangles, fitted over the frames of its clips.",
        AnimateOptions,
        ("INPUT",),
    ),
    "convert": Job(
        "Write a textured mesh of what is none. KIND says what SOURCE is: sdf (a distance field: "
        "FILE.py:NAME, whose code is run, or a grid in FILE.npz), scene (of Mitsuba: FILE.xml), "
        "images (FOLDER or its transforms.json), command (a program that renders; it is run).",
        ConvertOptions,
        ("KIND", "SOURCE"),
    ),
    "lod": Job(
        "Write a chain of levels of detail, each fitted for the size at which it is shown.",
        LodOptions,
        ("INPUT",),
    ),
    "compare": Job(
        "Measure how different two assets look: PSNR, FLIP, silhouettes.",
        CompareOptions,
        ("REFERENCE", "CANDIDATE"),
    ),
    "inspect": Job(
        "Say what is in an asset, what is wrong with it, and what simplify will do with each "
        "material.",
        InspectOptions,
        ("INPUT",),
        writes=False,
    ),
}
"""All jobs by name: a job is its record above, an entry here, and a recipe."""
