"""The command line: help, examples, and what is wrong before a command runs."""

import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import typer

from robomme_interference_data.cli.main import app

Run = Callable[..., tuple[int, str, str]]


def commands(
    command: Any = None, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command and group, with the words that call it."""
    command = command or typer.main.get_command(app)
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*path, name))


ALL = dict(commands())


GROUPS = {
    "Data": ["doctor", "build", "verify", "fetch"],
    "Look": ["conditions", "list", "show", "simulate"],
    "Training": ["train"],
    "Retrieval": ["index", "retrieve", "retrieval-score"],
    "Rollouts": ["ceiling", "evaluate", "ask", "merge", "vla-eval-config"],
    "Scores": ["score", "compare", "power"],
    "Publish": ["card", "publish", "publish-results", "submit", "leaderboard"],
}


def test_commands_are_listed_in_groups(run: Run) -> None:
    code, out, err = run("--help")
    assert (code, err) == (0, "")
    order = [name for title, names in GROUPS.items() for name in (title, *names)]
    found = re.findall(r"^[│╭]─? +?([A-Za-z-]+)", out, flags=re.M)
    assert [word for word in found if word in order] == order
    assert {name for (name, *_) in filter(None, ALL)} == {*order} - {*GROUPS}


def test_few_commands_with_few_options() -> None:
    assert len(ALL) - 1 <= 25
    for path, command in ALL.items():
        options = [one.name for one in command.params if one.param_type_name == "option"]
        assert len({*options} - {"help"}) <= 26, path


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_help_of_every_command(path: tuple[str, ...], run: Run) -> None:
    code, out, err = run(*path, "--help")
    assert (code, err) == (0, "")
    usage = "Usage: robomme-interference"
    assert usage in out
    assert "robomme-interference " in out.split(usage)[1].split("\n", 1)[1], "no example"
    for parameter in ALL[path].params:
        if parameter.name != "help":
            assert str(parameter.help or "").strip(), f"{parameter.name} has no help"
            if parameter.opts[0].startswith("--"):
                assert max(parameter.opts, key=len) in out


def test_help_shows_options_in_groups_and_examples(run: Run) -> None:
    out = run("index", "--help")[1]
    order = (" Embed", "Example", "─ Arguments", "─ Retrieval", "─ Execution", "--workers")
    assert [word for word in sorted(order, key=out.index)] == list(order)


@pytest.mark.slow
def test_examples_are_not_wrapped_in_80_columns(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are copied."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 80)
    for path, command in ALL.items():
        out = run(*path, "--help")[1]
        text = f"{command.help}\n{command.epilog}"
        for block in re.findall(r"```\n(.*?)```", text, flags=re.S):
            for line in filter(None, map(str.strip, block.splitlines())):
                assert line in out, path


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from robomme_interference_data.cli.main import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage:" in done.stdout
    found = set(done.stderr.split())
    assert found.isdisjoint(
        {"numpy", "pyarrow", "av", "scipy", "matplotlib", "torch", "lerobot", "huggingface_hub"}
    )


@pytest.mark.parametrize(("module", "times"), [("typer", 1), ("pyarrow", 1), ("pyarrow", 2)])
def test_ctrl_c_during_an_import_prints_no_traceback(module: str, times: int) -> None:
    code = f"""
import os, signal, sys
class Interrupt:
    def find_spec(self, name, *_):
        if name == "{module}":
            sys.meta_path.remove(self)
            try:
                os.kill(os.getpid(), signal.SIGINT)
            finally:
                for _ in range({times - 1}):
                    os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
sys.argv = ["robomme-interference", "conditions"]
from robomme_interference_data.cli import run_program
run_program()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode in {-signal.SIGINT, 128 + signal.SIGINT}, done
    assert "Traceback" not in done.stderr and done.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["lits"], "No such command 'lits'"),
        (["list", ".", "--bad"], "No such option: --bad"),
        (["build", "--source", "frames:."], "Missing argument"),
        (
            ["score", ".", "--out", "x", "--expected", "all"],
            "'--expected': 'all' is not one of 'benchmark', 'observed'",
        ),
        (["build"], "build [OPTIONS] {BUFFER_SET}\n"),
        (["list", ".", "--conditions", ""], "has an empty name"),
        (["build", ".", "--only", "manifests", "--conditions", "k0,,k1"], "has an empty name"),
        (["list", ".", "--conditions", "k0,k1", "--conditions", "k0"], "'k0' is given 2 times"),
        (["build", ".", "--source", "sample", "--cameras", " "], "has an empty name"),
    ],
)
def test_usage_errors(arguments: list[str], message: str, run: Run) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert "Traceback" not in err


def examples() -> list[str]:
    found = []
    for command in ALL.values():
        text = f"{command.help}\n{command.epilog}".replace("\\\n", " ")
        lines = map(str.strip, text.splitlines())
        found += [line for line in lines if line.startswith("robomme-interference ")]
    return found


@pytest.mark.slow
@pytest.mark.parametrize("line", examples())
def test_examples_parse(line: str) -> None:
    from support.command_lines import parse

    parse(shlex.split(line)[1:])
