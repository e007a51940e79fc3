"""Records of options: checked in every way they are given, composed by jobs, shown by the help."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
from typer.testing import CliRunner

from appearance_opt import cli
from appearance_opt.cli import app
from appearance_opt.config import (
    JOBS,
    PRESETS,
    CommonOptions,
    SimplifyOptions,
    as_dict,
    make_options,
    read_toml,
    resolve_options,
    simplify_options,
    with_values,
)
from appearance_opt.errors import InputError
from appearance_opt.options.option import Record, entries, flag_name, option, part
from appearance_opt.options.reading import AssetOptions
from appearance_opt.parameters import describe

NEED_TRIANGLES = tuple(JOBS[kind].options for kind in ("simplify", "animate", "convert"))

LEAST = {kind: {"triangles": 100} for kind in ("simplify", "animate", "convert")}
"""What a job cannot do without."""

RANGES = [
    (kind, key)
    for kind, job in JOBS.items()
    for key, e in entries(job.options).items()
    if e.spec.low is not None or e.spec.above is not None
]


@pytest.mark.parametrize("kind", JOBS)
def test_help_shows_every_option_with_its_range_and_default(kind: str) -> None:
    shown = CliRunner().invoke(app, [kind, "--help"], env={"COLUMNS": "80", "TERM": "dumb"})
    assert shown.exit_code == 0
    # where lines break is up to the parser
    text = "".join(shown.output.split())
    for key, entry in entries(JOBS[kind].options).items():
        assert f"--{flag_name(key)}" in text or entry.spec.flag, key
        assert "".join(describe(entry).split()) in text, key
        assert f"{entry.spec.panel}:" in text


def test_help_says_what_presets_set() -> None:
    known = entries(SimplifyOptions)
    assert "[from 16 to 4096; default: 256, draft 192, final 320]" in describe(known["resolution"])
    assert "default: 65s, draft 19s, final 280s]" in describe(known["budget"])
    assert "[decimate" not in describe(known["init"])
    assert all(set(v) <= set(known) for v in PRESETS.values())


@pytest.mark.parametrize(("kind", "key"), RANGES)
def test_values_out_of_range_are_refused_by_name(kind: str, key: str) -> None:
    spec = entries(JOBS[kind].options)[key].spec
    low = spec.above if spec.low is None else spec.low - 1
    for value in (low, None if spec.high is None else spec.high + 1):
        if value is not None:
            with pytest.raises(InputError, match=f"--{flag_name(key)} .*: must be "):
                given = {**LEAST.get(kind, {}), key: value}
                given.pop("triangles" if key == "ratio" else "", None)
                make_options(JOBS[kind].options, "default", given)


@pytest.mark.parametrize("kind", JOBS)
def test_flat_values_make_the_same_options(kind: str) -> None:
    made = make_options(JOBS[kind].options, "draft", LEAST.get(kind, {}))
    assert make_options(JOBS[kind].options, "final", as_dict(made)) == made
    assert with_values(made, crease_angle=30.0) != made
    assert with_values(made, crease_angle=30.0).asset.crease_angle == 30.0  # type: ignore[attr-defined]


def test_a_job_offers_a_part_of_a_record() -> None:
    with pytest.raises(
        InputError, match="unknown key 'position_rate': it is an option of simplify"
    ):
        make_options(JOBS["bake"].options, "default", {"position_rate": 0.1})
    with pytest.raises(AssertionError):
        part(AssetOptions, without=("refin",))


def test_keys_are_unique_and_every_option_has_a_panel_and_help() -> None:
    for job in JOBS.values():
        for entry in entries(job.options).values():
            assert entry.spec.panel and entry.spec.help.endswith("."), entry.key
    records = {f.metadata["part"].kind for j in JOBS.values() for f in fields(j.options)
               if "part" in f.metadata}  # fmt: skip
    for record in records:
        assert all("option" in f.metadata for f in fields(record)), record


def test_functions_take_options_values_or_both() -> None:
    made = resolve_options(SimplifyOptions, None, {"preset": "draft", "triangles": 9})
    assert made == simplify_options("draft", triangles=9)
    assert resolve_options(SimplifyOptions, made, {"budget": "2m"}).fit.budget == 120.0
    with pytest.raises(InputError, match="--triangles N or --ratio R"):
        resolve_options(SimplifyOptions, None, {})
    with pytest.raises(InputError, match="did you mean 'triangles'"):
        resolve_options(SimplifyOptions, made, {"triangle": 5})


def test_presets_are_of_jobs_that_fit() -> None:
    for job in JOBS.values():
        same = [make_options(job.options, p, {"triangles": 9} if job.options in NEED_TRIANGLES else {})
                for p in ("draft", "final")]  # fmt: skip
        assert (same[0] == same[1]) is not issubclass(job.options, CommonOptions)


def test_files_of_options_may_be_json(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(
        '{"texture-size": 512, "variant": ["look=worn"], "steps": null}'
    )
    values = read_toml(tmp_path / "a.json")
    made = simplify_options(triangles=9, **values)
    assert (made.texture.size, made.fit.steps) == (512, None)
    assert made.asset.arguments()["variants"] == {"look": "worn"}
    for text, words in (
        ("[1]", "no keys"),
        ("{", "not a valid JSON file"),
        ('{"a": 1}', "unknown"),
    ):
        (tmp_path / "b.json").write_text(text)
        with pytest.raises(InputError, match=words):
            read_toml(tmp_path / "b.json")


def test_a_file_may_spell_a_key_as_the_command_line_does(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('for = "web"\n')
    assert read_toml(tmp_path / "a.toml") == {"target": "web"}
    (tmp_path / "a.toml").write_text('for = "web"\ntarget = "game"\n')
    with pytest.raises(InputError, match="'target' is given twice"):
        read_toml(tmp_path / "a.toml")
    with pytest.raises(InputError, match="--for 3: expected"):
        simplify_options(triangles=9, target=3)


def test_variants_may_be_a_dictionary() -> None:
    made = simplify_options(triangles=9, variant={"look": "worn", "": "blue"})
    assert made.asset.variant == ("look=worn", "blue")
    assert made.asset.arguments()["variants"] == {"look": "worn", "": "blue"}


@pytest.mark.parametrize("value", ["=x", "", "look=", 3, ["a", 3]])
def test_variants_that_name_nothing_are_refused(value: object) -> None:
    with pytest.raises(InputError, match="--variant"):
        make_options(JOBS["inspect"].options, "default", {"variant": value})


def test_a_field_without_a_range_is_free() -> None:
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class Free(Record):
        name: str = option("", "Any.")
        share: float = option(0.5, "A share.", above=0, high=1)

    assert Free("x", 1.0).share == 1.0
    for wrong in (0.0, 1.5, float("nan")):
        with pytest.raises(InputError, match=r"--share .*: must be above 0 and at most 1"):
            Free("x", wrong)


def test_the_command_line_goes_before_a_file_and_a_file_before_the_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specs: list = []
    monkeypatch.setattr(cli, "_run", lambda spec, *others, **kept: specs.append(spec))
    file = tmp_path / "options.toml"
    file.write_text(
        'preset = "final"\ntriangles = 9\nvariant = "worn"\nresolution = 100\npool = 9\n'
    )
    words = ["simplify", "a.glb", "--out", "b.glb", "--config", str(file), "--ratio", "0.5"]
    assert CliRunner().invoke(app, [*words, "--pool", "7"]).exit_code == 0
    made = specs[0].options
    assert (made.start.triangles, made.start.ratio, made.start.reallocate) == (None, 0.5, 2)
    assert (made.views.resolution, made.views.pool, made.asset.variant) == (100, 7, ("worn",))
    assert CliRunner().invoke(app, [*words, "--preset", "draft", "--variant", "x"]).exit_code == 0
    assert (specs[1].options.fit.budget, specs[1].options.asset.variant) == (19.0, ("x",))
