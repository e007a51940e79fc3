"""How a source that is no mesh is opened and drawn."""

from __future__ import annotations

from dataclasses import dataclass

from appearance_opt.options.option import Record, duration, option

LIGHTINGS = ("scene", "views")


@dataclass(frozen=True)
class SourceOptions(Record):
    """``shape``, ``lighting``, ``paths``: of a Mitsuba scene. ``startup``, ``timeout`` (seconds): of
    a command. ``unlit``: the light of the images is baked into colours."""

    shape: str | None = option(
        None,
        "Id of the only shape of a scene that is shown.",
        panel="Input",
        metavar="ID",
        automatic="all but lights",
    )
    lighting: str = option(
        "scene",
        "Of a scene: its own lights, which are baked in, or a lamp of its own in each view.",
        panel="Input",
        choices=LIGHTINGS,
    )
    paths: int = option(64, "Paths per pixel of a scene.", panel="Input", low=1, high=65536)
    startup: float | None = option(
        60.0,
        "Time that a command has for its first answer.",
        panel="Input",
        above=0,
        expected="a positive time such as 60s",
        metavar="TIME",
        parse=duration,
    )
    timeout: float | None = option(
        120.0,
        "Time that a command has for each view.",
        panel="Input",
        above=0,
        expected="a positive time such as 60s",
        metavar="TIME",
        parse=duration,
    )
    unlit: bool = option(
        False,
        "Bake the light of the images into colours that are shown without any "
        "(KHR_materials_unlit); so it is in any case where their light stands still.",
        panel="Output",
        flag="--unlit",
    )
