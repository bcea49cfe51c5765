"""Settings declared once: as a dataclass, and as the options of a command."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from robomme_interference_data.cli.main import app as whole
from robomme_interference_data.cli.options import AsJson, with_settings
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.settings import setting


@dataclass(frozen=True)
class Config:
    buffer_set: Path = setting(help="The buffer set.", name="-")
    out: Path = setting(help="The folder.")
    families: tuple[str, ...] = setting(("all",), help="Families.")
    source: tuple[str, ...] = setting((), help="Sources.", whole=True)
    split: str = setting("test", help="Split.")
    k: int | None = setting(None, help="Number.")
    videos: bool = setting(False, help="Clips.", name="--videos")
    limit_s: float = setting(9.0, help="Limit.", rare=True)
    resume: bool = setting(True, help="Resume.", rare=True)

    def __post_init__(self) -> None:
        seen.append(self)


seen: list[Any] = []
app = typer.Typer()


@app.command()
@with_settings
def command(config: Config, as_json: AsJson = False) -> None:
    """Do it."""
    seen.append(as_json)


def called(*arguments: str) -> list[Any]:
    seen.clear()
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    return list(seen)


def test_defaults_are_those_of_the_dataclass() -> None:
    assert called("S", "--out", "o") == [Config(Path("S"), Path("o")), False]


@pytest.mark.parametrize("families", [["A,B,C"], ["A", "B", "C"], ["A, B", "C"]])
def test_lists_are_repeated_or_separated_by_commas(families: list[str]) -> None:
    repeated = [word for family in families for word in ("--families", family)]
    config, _ = called(*repeated, "S", "--out", "o")
    assert (config.buffer_set, config.families) == (Path("S"), ("A", "B", "C"))


def test_rare_settings_share_an_option() -> None:
    config, _ = called("S", "--out=o", "--set", "limit_s=3", "--set", "resume=false")
    assert (config.limit_s, config.resume) == (3.0, False)
    for wrong in ("limit_s=soon", "limit_s=1.5.2", "resume=1", "limits=3", "limit_s"):
        result = CliRunner().invoke(app, ["S", "--out=o", "--set", wrong])
        assert isinstance(result.exception, InvalidOptionError)
    assert "--limit-s" not in CliRunner().invoke(app, ["--help"]).output


def test_no_command_has_more_than_26_options() -> None:
    options = {" ".join(words): names for words, names in options_of(get_command(whole), [])}
    assert "policies" in options["evaluate"]
    assert max(map(len, options.values())) <= 26


def options_of(group: Any, words: list[str]) -> Iterator[tuple[list[str], list[str]]]:
    """The options of each command of a group, but `--help`."""
    for name, sub in getattr(group, "commands", {}).items():
        yield from options_of(sub, [*words, name])
    if not hasattr(group, "commands"):
        yield words, [one.name for one in group.params if one.param_type_name == "option"]


def test_all_options() -> None:
    config, as_json = called(
        "S", "--k=7", "--videos", "--split=val", "--out=o", "--source=x:a,b", "--json"
    )
    expected = Config(Path("S"), Path("o"), k=7, split="val", videos=True, source=("x:a,b",))
    assert config == expected and as_json  # a value of `whole` keeps its comma


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["S"], "--out"),
        (["S", "--out", "o", "--famlies", "A"], "--families"),
        (["S", "--out", "o", "--k", "x"], "--k"),
    ],
)
def test_usage_errors(arguments: list[str], option: str) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert option in result.output
