"""The command line: help, exit codes and errors without a traceback; as a program."""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import factories
import pytest
import typer

from robomme_interference_data.cli import app, spread

EPISODE = "VideoUnmask/test/1"
SCRIPT = Path(sys.executable).with_name("robomme-interference")

Run = Callable[..., tuple[int, str, str]]


def commands(
    command: Any = None, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command and group, with the words that call it."""
    command = command or typer.main.get_command(app)
    yield path, command
    for name, inner in sorted(getattr(command, "commands", {}).items()):
        yield from commands(inner, (*path, name))


ALL = dict(commands())


# --- help ------------------------------------------------------------------------------------


def test_the_commands() -> None:
    assert {
        ("list",),
        ("show",),
        ("verify",),
        ("audit",),
        ("doctor",),
        ("build", "all"),
        ("build", "demonstrations"),
        ("build", "distractors"),
        ("build", "manifests"),
        ("build", "sample"),
    } <= ALL.keys()


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_help_of_every_command(path: tuple[str, ...], run: Run) -> None:
    code, out, err = run(*path, "--help")
    assert (code, err) == (0, "")
    assert "Usage: robomme-interference" in out
    command = ALL[path]
    assert str(command.help).strip()
    for parameter in command.params:
        if parameter.name != "help":
            assert str(parameter.help or "").strip(), f"{parameter.name} has no help"
            if isinstance(parameter, click.Option) or parameter.opts[0].startswith("--"):
                assert max(parameter.opts, key=len) in out
    for name in getattr(command, "commands", {}):
        assert name in out


@pytest.mark.parametrize(
    "path", [path for path, command in ALL.items() if hasattr(command, "commands")], ids=" ".join
)
def test_groups_without_a_command_show_their_help(path: tuple[str, ...], run: Run) -> None:
    code, out, err = run(*path)
    assert code == 2
    assert "Usage: robomme-interference" in out + err


def examples() -> list[str]:
    found = []
    for command in ALL.values():
        lines = str(command.epilog or "").replace("\\\n", " ").splitlines()
        found += [line.strip() for line in lines if line.strip().startswith("robomme-interference")]
    return found


def test_there_are_examples() -> None:
    assert len(examples()) >= 8


@pytest.mark.parametrize("line", examples())
def test_examples_name_commands_and_options_that_exist(line: str) -> None:
    words = shlex.split(line)[1:]
    path: tuple[str, ...] = ()
    while words and (*path, words[0]) in ALL:
        path += (words.pop(0),)
    assert path, line
    options = {name for parameter in ALL[path].params for name in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= options


# --- usage errors ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lits"], "No such command 'lits'"),
        (["list"], "Missing argument"),
        (["list", ".", "--bad"], "No such option: --bad"),
        (["show", EPISODE], "Missing option '--k'"),
        (["show", EPISODE, "--k", "three"], "Invalid value for '--k'"),
        (["list", ".", "--k", "1", "3"], "Got unexpected extra argument"),
        (["build", "demonstrations", "--source", "frames:."], "Missing option '--out'"),
    ],
)
def test_usage_errors(arguments: list[str], message: str, run: Run) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("given", "taken"),
    [
        ([], []),
        (["build", "--k", "0", "1", "3"], ["build", "--k", "0", "--k", "1", "--k", "3"]),
        (["build", "--k", "0"], ["build", "--k", "0"]),
        (["build", "--k"], ["build", "--k"]),
        (
            ["build", "--k", "0", "1", "--seed", "5"],
            ["build", "--k", "0", "--k", "1", "--seed", "5"],
        ),
        (["build", "--seed", "5", "6"], ["build", "--seed", "5", "6"]),
        (
            ["build", "--k", "0", "--k", "1", "2"],
            ["build", "--k", "0", "--k", "1", "--k", "2"],
        ),
        (["build", "--k=0", "1"], ["build", "--k=0", "1"]),
        (["list", "--k", "0", "1"], ["list", "--k", "0", "1"]),
        (
            ["evaluate", "--conditions", "no-history", "k7", "--families", "A", "--out", "x"],
            [
                "evaluate",
                "--conditions",
                "no-history",
                "--conditions",
                "k7",
                "--families",
                "A",
                "--out",
                "x",
            ],
        ),
    ],
)
def test_spread(given: list[str], taken: list[str]) -> None:
    assert spread(given) == taken


# --- known errors ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "lines"),
    [
        (
            ["list", "{}/nowhere"],
            ["Error: {}/nowhere is not a split: manifests/manifest.json is missing", "Point to"],
        ),
        (
            ["list", "{}", "--family", "VideoUnmsk"],
            [
                "Error: family 'VideoUnmsk' is not in {}/manifests",
                "Did you mean 'VideoUnmask'?",
            ],
        ),
        (["list", "{}", "--k", "9"], ["Error: k 9 is not in {}/manifests", "Known: 0, 1, 3"]),
        (
            ["show", "VideoUnmask/test/9", "--split", "{}", "--k", "3"],
            ["Error: VideoUnmask/test/9 is not in {}/manifests", "Did you mean 'VideoUnmask/test/"],
        ),
        (
            ["show", "VideoUnmask", "--split", "{}", "--k", "3"],
            ["Error: 'VideoUnmask' is not an episode id", "Expected <Family>/<split>/<index>"],
        ),
        (
            ["show", EPISODE, "--split", "{}", "--k", "9"],
            ["Error: k=9 is not in {}/manifests", "Planned there: 0, 1, 3."],
        ),
        (["verify", "{}/nowhere"], ["Error: {}/nowhere is not a split", "Point to the folder"]),
        (["audit", "{}/nowhere"], ["Error: {}/nowhere is not a split", "Point to the folder"]),
        (
            ["build", "distractors", "--source", "frmes:{}", "--out", "{}/out"],
            ["Error: --source 'frmes:{}' is not KIND:LOCATION", "Did you mean 'frames'?"],
        ),
    ],
)
def test_known_errors(arguments: list[str], lines: list[str], run: Run) -> None:
    root = str(factories.split())
    code, out, err = run(*(argument.replace("{}", root) for argument in arguments))
    assert (code, out) == (1, "")
    assert "Traceback" not in err
    found = err.splitlines()
    assert len(found) == len(lines)
    for line, expected in zip(found, lines, strict=True):
        assert line.startswith(expected.replace("{}", root))


# --- as a program ---------------------------------------------------------------------------------


def script(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [SCRIPT, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        **options,
    )


def test_console_script() -> None:
    done = script("list", factories.split(), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert len([json.loads(line) for line in done.stdout.splitlines()]) == 24


def test_console_script_fails_without_a_traceback(tmp_path: Path) -> None:
    done = script("show", EPISODE, "--split", tmp_path, "--k", 3)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(f"Error: {tmp_path} is not a split")
    assert "Traceback" not in done.stderr


def test_a_folder_that_cannot_be_made_is_one_error(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, out, err = run("build", "sample", "--out", tmp_path / "file" / "sample")
    assert (code, out) == (1, "")
    message, hint = err.splitlines()[-2:]
    assert message.startswith(f"Error: {tmp_path}/file/sample")
    assert message.endswith(": Not a directory")
    assert hint == "Check the path, its permissions and the space left on the disk."


def test_console_script_takes_the_split_from_the_environment() -> None:
    environment = {**os.environ, "ROBOMME_INTERFERENCE_SPLIT": str(factories.split())}
    done = script("show", EPISODE, "--k", 3, "--json", env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["episode_id"] == EPISODE


def test_the_reader_of_stdout_may_go_away() -> None:
    """As with `robomme-interference list … | head`."""
    with subprocess.Popen(
        [SCRIPT, "list", factories.split(), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.wait(120) == 1
        assert process.stderr.read() == ""
