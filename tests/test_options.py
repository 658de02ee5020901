"""Options: one declaration for the command line, Python, the environment, and the record."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import pytest

from neuros.options import Option, add_options, option, options_of, recorded_values, values_of


@dataclass(frozen=True, kw_only=True)
class Settings:
    speed: float = option("--speed", default=1.0, parse=float, metavar="FACTOR", help="how fast")
    nodes: tuple[str, ...] = option("-n", "--node", is_repeatable=True, help="start this")
    is_placed: bool = option("--no-placement", default=True, help="ignore cores")
    bar: bool | None = option("--bar", is_negatable=True, help="show a bar", is_recorded=False)
    where: str | None = option("--where", variable="WHERE", default_help="here", help="a place")
    folder: object = option(help="for Python alone")


def parsed(*words: str) -> Settings:
    parser = argparse.ArgumentParser()
    add_options(parser, options_of(Settings))
    return Settings(**values_of(options_of(Settings), parser.parse_args(words)))


def test_what_is_not_given_has_its_default() -> None:
    assert parsed() == Settings()
    assert Settings().nodes == ()


def test_every_kind_of_option_is_parsed() -> None:
    given = parsed(
        "--speed", "2", "-n", "a", "--node", "b", "--no-placement", "--no-bar", "--where=x"
    )
    expected = Settings(speed=2.0, nodes=("a", "b"), is_placed=False, bar=False, where="x")
    assert given == expected


def test_two_parsers_share_no_values() -> None:
    assert parsed("-n", "a").nodes == ("a",)
    assert parsed().nodes == ()


def test_a_wrong_value_ends_in_the_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parsed("--speed", "fast")
    assert ended.value.code == 2
    assert "argument --speed: invalid float value: 'fast'" in capsys.readouterr().err


def test_the_help_says_defaults_and_what_may_be_repeated() -> None:
    helps = {each.name: each.full_help for each in options_of(Settings)}
    assert helps["speed"] == "how fast (default: 1.0)"
    assert helps["nodes"] == "start this (repeatable)"
    assert helps["where"] == "a place (default: WHERE, else here)"
    assert helps["is_placed"] == "ignore cores"


def test_choices_may_be_found_late() -> None:
    found = ["process"]
    parser = argparse.ArgumentParser()
    add_options(parser, [Option(("--backend",), "where", choices=lambda: found)])
    assert parser.parse_args(["--backend", "process"]).backend == "process"
    with pytest.raises(SystemExit):
        parser.parse_args(["--backend", "moon"])


def test_the_environment_comes_before_the_default_and_after_what_is_given() -> None:
    where = Option(("--where",), "a place", default="here", variable="WHERE")
    assert where.value(None, {}) == where.value(None, {"WHERE": ""}) == "here"
    assert where.value(None, {"WHERE": "there"}) == "there"
    assert where.value("moon", {"WHERE": "there"}) == "moon"


def test_the_record_has_what_json_knows() -> None:
    assert recorded_values(Settings(nodes=("a",), folder=Path("x"))) == {
        "speed": 1.0,
        "nodes": ["a"],
        "is_placed": True,
        "where": None,
        "folder": "x",
    }


def test_options_with_a_heading_stand_below_it() -> None:
    parser = argparse.ArgumentParser()
    add_options(parser, [Option(("--partition",), "where", group="options of slurm")])
    assert "options of slurm:\n  --partition" in parser.format_help()


def test_an_option_without_flag_and_name_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a name"):
        Option((), "for nothing")
