"""The command line: parse, call a job, print. No heavy import happens before a command runs."""

from __future__ import annotations

import errno
import logging
import signal
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from appearance_opt import __version__
from appearance_opt.errors import AppearanceError, InputError

BEGAN = time.perf_counter()
"""Time budgets count from here: importing is part of a run."""

INTERRUPTED = 130
"""Exit code after a Ctrl-C that ended a command: 128 + SIGINT, as shells have it."""

VARIANT = "Variant: set=name for USD (repeatable), a name for glTF."

INTERRUPTION = "interrupted; what was written is complete"

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="Simplify 3D assets so that the result looks the same.",
)


def main() -> None:
    """Entry point: every expected failure is one line and exit code 2."""
    # what libraries log of the files they read is no message of ours: errors and notes say it
    logging.getLogger().addHandler(logging.NullHandler())
    ours = logging.StreamHandler()
    ours.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    logging.getLogger("appearance_opt").addHandler(ours)
    # schedulers of clusters end a job so: like Ctrl-C, it keeps the best state
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = app(standalone_mode=False)
        if code == INTERRUPTED:  # how typer hands on a Ctrl-C
            raise KeyboardInterrupt
        # all is done: a Ctrl-C while the interpreter takes itself apart must not look like a
        # failure
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    except AppearanceError as error:
        _fail(str(error))
    except OSError as error:
        reason = (
            "the disk is full" if error.errno == errno.ENOSPC else (error.strerror or str(error))
        )
        _fail(f"{error.filename or 'file'}: {reason}")
    except KeyboardInterrupt:
        _fail(INTERRUPTION, INTERRUPTED)
    except MemoryError:
        _fail("not enough memory; try a smaller --texture-size, --resolution or --pool")
    except Exception as error:
        # the parser's own errors (typer may bundle its parser, so they are known by what they can
        # do)
        if type(error).__name__ == "Abort":  # a Ctrl-C, in other versions of typer
            _fail(INTERRUPTION, INTERRUPTED)
        if not hasattr(error, "format_message"):
            raise
        _fail(error.format_message())


def _fail(message: str, code: int = 2) -> None:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    sys.exit(code)


def _version(show: bool) -> None:
    if show:
        print(f"appearance-opt {__version__}")
        raise SystemExit(0)


# options that mean the same in several commands
PresetOption = Annotated[str | None, typer.Option(help="draft, default or final.")]
TextureSizeOption = Annotated[
    int | None, typer.Option(help="Texels per side of the maps (power of two).")
]
ResolutionOption = Annotated[int | None, typer.Option(help="Pixels per side of a training view.")]
ViewsOption = Annotated[int | None, typer.Option(help="Views per step.")]
PoolOption = Annotated[int | None, typer.Option(help="Reference views kept at a time.")]
ReuseOption = Annotated[
    int | None,
    typer.Option(help="How often each view is seen before a new one replaces it; 0: they stay."),
]
StepsOption = Annotated[int | None, typer.Option(help="Stop after this many steps.")]
BudgetOption = Annotated[str | None, typer.Option(help="Wall-clock time for everything: 60s, 5m.")]
NormalRateOption = Annotated[float | None, typer.Option(help="Learning rate of the normal map.")]
ColorRateOption = Annotated[float | None, typer.Option(help="Learning rate of the base colour.")]
MaterialRateOption = Annotated[
    float | None, typer.Option(help="Learning rate of roughness, metalness.")
]
BackgroundOption = Annotated[str | None, typer.Option(help="random, black, white, grey or r,g,b.")]
LightOption = Annotated[str | None, typer.Option(help="point (random) or headlight.")]
SeedOption = Annotated[int | None, typer.Option(help="Seed of views and lights.")]
RefineOption = Annotated[
    int | None, typer.Option(help="Level to which USD subdivision surfaces are refined.")
]
MissingTexturesOption = Annotated[
    str | None,
    typer.Option(help="error or ignore, when the input names a texture that is not there."),
]
CreaseAngleOption = Annotated[
    float | None,
    typer.Option(
        help="STL, PLY, OBJ without normals: edges sharper than this (degrees) are hard [40, more in noise]."
    ),
]
RootOption = Annotated[
    str | None,
    typer.Option(help="Folder in which files that the input refers to may lie, beside its own."),
]
DeviceOption = Annotated[str | None, typer.Option(help="auto, cpu or cuda.")]
ReportOption = Annotated[
    Path | None, typer.Option(help="Folder for the report [OUT's name + .report].")
]
NoReportOption = Annotated[bool, typer.Option("--no-report", help="Write no report.")]
ConfigOption = Annotated[Path | None, typer.Option(help="TOML file with the same keys.")]


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Simplify 3D assets so that the result looks the same."""


@app.command()
def simplify(
    source: Annotated[
        Path, typer.Argument(metavar="INPUT", help=".glb .gltf .usd* .obj .ply .stl")
    ],
    out: Annotated[Path, typer.Option(help="Result: .glb .gltf .usd* .obj")],
    triangles: Annotated[int | None, typer.Option(help="At most this many triangles.")] = None,
    ratio: Annotated[
        float | None, typer.Option(help="Fraction of the input's triangles instead.")
    ] = None,
    preset: PresetOption = None,
    texture_size: TextureSizeOption = None,
    resolution: ResolutionOption = None,
    views: ViewsOption = None,
    pool: PoolOption = None,
    reuse: ReuseOption = None,
    steps: StepsOption = None,
    budget: BudgetOption = None,
    fit: Annotated[str | None, typer.Option(help="Subset of shape,normal,material.")] = None,
    init: Annotated[
        str | None, typer.Option(help="decimate, sphere, or a file to start from.")
    ] = None,
    reallocate: Annotated[
        int | None, typer.Option(help="Rounds of moving triangles to the image error.")
    ] = None,
    loss: Annotated[
        str | None, typer.Option(help="log-srgb-l1, log-srgb-l2, l1, l2, smape, relative-l2.")
    ] = None,
    laplacian: Annotated[
        float | None, typer.Option(help="Weight of the Laplacian (0: off).")
    ] = None,
    relative: Annotated[
        bool | None, typer.Option("--relative/--absolute", help="Laplacian of the start, or 0.")
    ] = None,
    position_rate: Annotated[
        float | None, typer.Option(help="In units of the local edge length.")
    ] = None,
    normal_rate: NormalRateOption = None,
    color_rate: ColorRateOption = None,
    material_rate: MaterialRateOption = None,
    background: BackgroundOption = None,
    light: LightOption = None,
    seed: SeedOption = None,
    keep_hidden: Annotated[
        bool | None, typer.Option(help="Keep geometry that nobody sees.")
    ] = None,
    displacement: Annotated[
        bool | None, typer.Option("--displacement", help="Fit a displacement map.")
    ] = None,
    subdivision: Annotated[
        str | None, typer.Option(help="Tessellation, 0 to 4: 3, or 1,2,3 for all of them.")
    ] = None,
    displacement_rate: Annotated[
        float | None, typer.Option(help="In units of the finest edge length.")
    ] = None,
    write_tessellated: Annotated[
        bool | None, typer.Option("--write-tessellated", help="Write them, too.")
    ] = None,
    normal_map: Annotated[bool | None, typer.Option(help="Make a normal map at all.")] = None,
    refine: RefineOption = None,
    missing_textures: MissingTexturesOption = None,
    root: RootOption = None,
    crease_angle: CreaseAngleOption = None,
    variant: Annotated[list[str] | None, typer.Option(help=VARIANT)] = None,
    device: DeviceOption = None,
    report: ReportOption = None,
    no_report: NoReportOption = False,
    checkpoint: Annotated[Path | None, typer.Option(help="Folder for checkpoints.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint.")] = False,
    config: ConfigOption = None,
) -> None:
    """Write an asset with fewer triangles that looks like INPUT."""
    arguments = dict(locals())
    from appearance_opt.config import OPTION_NAMES, read_toml, simplify_options

    given = {k: v for k, v in arguments.items() if k in OPTION_NAMES and v is not None}

    values: dict[str, Any] = read_toml(config) if config is not None else {}
    if "triangles" in given or "ratio" in given:  # one replaces the other
        values.pop("triangles", None)
        values.pop("ratio", None)
    values.update(given)
    name = preset or values.pop("preset", None) or "default"
    values.pop("preset", None)
    options = simplify_options(name, **values)
    from appearance_opt.jobs.simplify import simplify as run
    from appearance_opt.progress import TerminalProgress

    folder = None if no_report else report or out.with_name(out.stem + ".report")
    with TerminalProgress() as progress:
        result = run(
            source,
            out,
            options,
            report=folder,
            checkpoint=checkpoint,
            resume=resume,
            progress=progress,
            variants=_variants(variant),
            began=BEGAN,
            inputs=[] if config is None else [config],
        )
    _print_result(out, result, folder)


@app.command()
def bake(
    high: Annotated[Path, typer.Argument(metavar="HIGH", help="What it shall look like.")],
    low: Annotated[
        Path, typer.Argument(metavar="LOW", help="Keeps its shape and its texture coordinates.")
    ],
    out: Annotated[Path, typer.Option(help="Result: .glb .gltf .usd* .obj")],
    maps: Annotated[
        str | None,
        typer.Option(
            help="normal,material,base-color,orm,emission,displacement,object-normal,ao,curvature."
        ),
    ] = None,
    closed_form: Annotated[
        bool | None, typer.Option("--closed-form", help="Rays alone, no fit: seconds.")
    ] = None,
    fit: Annotated[str | None, typer.Option(help="Subset of normal,material.")] = None,
    preset: PresetOption = None,
    texture_size: TextureSizeOption = None,
    samples: Annotated[int | None, typer.Option(help="Rays per texel.")] = None,
    cage: Annotated[
        float | None, typer.Option(help="How far rays go, metres [from the two meshes].")
    ] = None,
    hit: Annotated[str | None, typer.Option(help="nearest or outermost surface.")] = None,
    green: Annotated[
        str | None, typer.Option(help="Green of loose normal maps: opengl or directx.")
    ] = None,
    bits: Annotated[
        int | None, typer.Option(help="8 or 16, of normal maps and loose maps.")
    ] = None,
    texture_format: Annotated[str | None, typer.Option(help="Of loose maps: png or exr.")] = None,
    ao_rays: Annotated[
        int | None, typer.Option(help="Rays per sample of ambient occlusion.")
    ] = None,
    ao_distance: Annotated[
        float | None, typer.Option(help="Reach of ambient occlusion, metres [any].")
    ] = None,
    unwrap: Annotated[
        bool | None, typer.Option("--unwrap", help="Make a new atlas for LOW.")
    ] = None,
    align: Annotated[
        bool | None, typer.Option("--align", help="Fit HIGH to LOW: translation, scale.")
    ] = None,
    resolution: ResolutionOption = None,
    views: ViewsOption = None,
    pool: PoolOption = None,
    reuse: ReuseOption = None,
    steps: StepsOption = None,
    budget: BudgetOption = None,
    loss: Annotated[str | None, typer.Option(help="As for simplify.")] = None,
    normal_rate: NormalRateOption = None,
    color_rate: ColorRateOption = None,
    material_rate: MaterialRateOption = None,
    background: BackgroundOption = None,
    light: LightOption = None,
    seed: SeedOption = None,
    refine: RefineOption = None,
    missing_textures: MissingTexturesOption = None,
    root: RootOption = None,
    crease_angle: CreaseAngleOption = None,
    variant: Annotated[list[str] | None, typer.Option(help=f"HIGH: {VARIANT}")] = None,
    device: DeviceOption = None,
    joint: Annotated[
        bool | None, typer.Option("--joint", help="Fit LOW's shape and a displacement, too.")
    ] = None,
    subdivision: Annotated[
        str | None, typer.Option(help="Tessellation with --joint: 3, or 1,2,3.")
    ] = None,
    position_rate: Annotated[
        float | None, typer.Option(help="With --joint: as for simplify.")
    ] = None,
    displacement_rate: Annotated[
        float | None, typer.Option(help="With --joint: as for simplify.")
    ] = None,
    write_tessellated: Annotated[
        bool | None, typer.Option("--write-tessellated", help="With --joint.")
    ] = None,
    textures: Annotated[
        Path | None, typer.Option(help="Folder for the maps as loose files.")
    ] = None,
    report: ReportOption = None,
    no_report: NoReportOption = False,
    config: ConfigOption = None,
) -> None:
    """Bake what HIGH looks like into the maps of LOW."""
    arguments = dict(locals())
    from appearance_opt.config import BAKE_OPTION_NAMES, bake_options, read_toml

    values: dict[str, Any] = read_toml(config, BAKE_OPTION_NAMES) if config is not None else {}
    values.update({k: v for k, v in arguments.items() if k in BAKE_OPTION_NAMES and v is not None})
    name = preset or values.get("preset") or "default"
    values.pop("preset", None)
    options = bake_options(name, **values)
    from appearance_opt.jobs.bake import bake as run
    from appearance_opt.progress import TerminalProgress

    folder = None if no_report else report or out.with_name(out.stem + ".report")
    if options.joint:
        if textures is not None:
            raise InputError(
                f"--textures {textures}: a joint bake writes no loose maps; leave it out"
            )
        from appearance_opt.jobs.joint import joint as run_joint

        with TerminalProgress() as progress:
            joined = run_joint(
                high,
                low,
                out,
                options,
                report=folder,
                progress=progress,
                variants=_variants(variant),
                began=BEGAN,
                inputs=[] if config is None else [config],
            )
        _print_result(out, joined, folder)
        return
    with TerminalProgress() as progress:
        result = run(
            high,
            low,
            out,
            options,
            report=folder,
            textures=textures,
            progress=progress,
            variants=_variants(variant),
            began=BEGAN,
            inputs=[] if config is None else [config],
        )
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    quality = ""
    if result.fit is not None and result.fit.curve:
        curve = result.fit.curve
        quality = f", held-out PSNR {curve[0].psnr:.2f} -> {max(p.psnr for p in curve):.2f} dB"
    missed = f"{100 * result.missed_share:.2f} % of the texels missed"
    print(f"{out}: {','.join(options.maps)}, {missed}, {result.seconds['total']:.1f} s{quality}")
    if folder is not None and (folder / "report.html").is_file():
        print(f"report: {folder / 'report.html'}")


@app.command()
def compare(
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE")],
    candidate: Annotated[Path, typer.Argument(metavar="CANDIDATE")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the metrics as JSON.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for pictures and a report.")] = None,
    views: Annotated[int, typer.Option(help="Number of views.", min=1)] = 12,
    resolution: Annotated[int, typer.Option(help="Pixels per side.", min=16)] = 384,
    seed: Annotated[int, typer.Option(help="Seed of views and lights.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    refine: Annotated[
        int, typer.Option(help="Level to which USD subdivision surfaces are refined.")
    ] = 1,
    missing_textures: MissingTexturesOption = "error",
    root: RootOption = None,
    crease_angle: CreaseAngleOption = None,
    variant: Annotated[list[str] | None, typer.Option(help=f"REFERENCE: {VARIANT}")] = None,
) -> None:
    """Measure how different two assets look: PSNR, FLIP, silhouettes."""
    from appearance_opt.jobs.compare import compare as run

    result = run(
        reference,
        candidate,
        views=views,
        resolution=resolution,
        seed=seed,
        device=device,
        out=out,
        refine=refine,
        missing_textures=missing_textures,  # type: ignore[arg-type]
        root=root,
        crease_angle=crease_angle,
        variants=_variants(variant),
    )
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    metrics = result.metrics
    if as_json:
        import json
        from dataclasses import asdict

        print(json.dumps(asdict(metrics), indent=1))
        return
    print(f"PSNR, covered pixels  {metrics.psnr_covered:7.2f} dB")
    print(f"PSNR, whole image     {metrics.psnr:7.2f} dB")
    print(f"FLIP                  {metrics.flip:7.4f}")
    print(f"silhouette IoU        {metrics.silhouette_iou:7.4f}")
    print(f"silhouette shift      {metrics.silhouette_shift:7.3f} px")


@app.command()
def inspect(
    source: Annotated[
        Path, typer.Argument(metavar="INPUT", help=".glb .gltf .usd* .obj .ply .stl")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
    refine: Annotated[
        int, typer.Option(help="Level to which USD subdivision surfaces are refined.")
    ] = 1,
    missing_textures: MissingTexturesOption = "error",
    root: RootOption = None,
    crease_angle: CreaseAngleOption = None,
    variant: Annotated[list[str] | None, typer.Option(help=VARIANT)] = None,
) -> None:
    """Say what is in an asset, what is wrong with it, and what simplify will do with each
    material."""
    from appearance_opt.jobs.inspect import inspect as run

    found = run(
        source,
        refine=refine,
        variants=_variants(variant),
        missing_textures=missing_textures,  # type: ignore[arg-type]
        root=root,
        crease_angle=crease_angle,
    )
    if as_json:
        import json

        print(json.dumps(found.record(), indent=1))
        return
    print("\n".join(found.lines()))


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False) -> None:
    """Say what this machine offers, and what to install when something is missing."""
    from appearance_opt.doctor import diagnose

    found = diagnose()
    if as_json:
        import json

        print(json.dumps(found, indent=1))
    else:
        for name, value in found.items():
            print(f"{name:16} {value}")
    if found["problem"]:
        raise AppearanceError(str(found["problem"]))


def _print_result(out: Path, result: Any, folder: Path | None) -> None:
    """What a job that fits shape and maps has done."""
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)
    curve = result.fit.curve
    quality = (
        f", held-out PSNR {curve[0].psnr:.2f} -> {max(p.psnr for p in curve):.2f} dB"
        if curve
        else ""
    )
    kept = f" and {result.kept_triangles} kept as they are" if result.kept_triangles else ""
    counts = f"{result.triangles} of {result.source_triangles} triangles{kept}"
    print(f"{out}: {counts}, {result.seconds['total']:.1f} s{quality}")
    if folder is not None and (folder / "report.html").is_file():
        print(f"report: {folder / 'report.html'}")


def _variants(given: list[str] | None) -> dict[str, str] | None:
    out = {}
    for text in given or []:
        name, separator, choice = text.partition("=") if "=" in text else ("", "", text)
        if (separator and not name) or not choice:
            raise InputError(f"--variant {text}: write it as set=name for USD, as a name for glTF")
        out[name] = choice
    return out or None
