"""The command line: help, exit codes and errors without a traceback; as a program."""

import json
import logging
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import typer
from support.buffer_sets import QUERIES, contents

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cli import doctor
from robomme_interference_data.cli.console import echo, log_to_stderr, print_json
from robomme_interference_data.cli.main import app, main
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.schema.codec import to_dict

EPISODE = QUERIES[1]
SCRIPT = Path(sys.executable).with_name("robomme-interference")

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


def in_buffer_set(arguments: str, buffer_set: Path) -> list[str]:
    """Words of a command line, in which S stands for the buffer set."""
    return [re.sub(r"(^|:)S(?=/|$)", rf"\g<1>{buffer_set}", word) for word in arguments.split()]


# --- help ------------------------------------------------------------------------------------


GROUPS = {
    "Data": ["doctor", "build", "verify", "fetch"],
    "Look": ["conditions", "list", "show", "simulate"],
    "Retrieval": ["index", "retrieve", "retrieval-score"],
    "Rollouts": ["ceiling", "evaluate", "ask", "merge", "vla-eval-config"],
    "Scores": ["score", "compare", "power"],
    "Publish": ["card", "publish", "publish-results"],
}


def test_commands_are_listed_in_groups(run: Run) -> None:
    code, out, err = run("--help")
    assert (code, err) == (0, "")
    order = [name for title, names in GROUPS.items() for name in (title, *names)]
    found = re.findall(r"^[│╭]─? +?([A-Za-z-]+)", out, flags=re.M)
    assert [word for word in found if word in order] == order
    assert {name for (name, *_) in filter(None, ALL)} == {*order} - {*GROUPS}


def test_few_commands_with_few_options() -> None:
    assert len(ALL) - 1 <= 22
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


# --- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("list S/nowhere", ("neither a folder nor", "namespace/name")),
        ("list S --conditions k9", ("'k9'", "--only manifests", "--conditions k9")),
        ("show S MoveCube/test/9 k3", ("MoveCube/test/9", EPISODE)),
        ("build S/x --only distractors --source frmes:S", ("frmes", "frames:FOLDER")),
    ],
)
def test_known_errors(arguments: str, words: tuple[str, ...], run: Run, tiny_buffers: Path) -> None:
    code, out, err = run(*in_buffer_set(arguments, tiny_buffers))
    assert (code, out) == (1, "")
    assert err.startswith("Error: ") and "Traceback" not in err
    assert all(text in err for text in words), err


@pytest.mark.parametrize(
    ("arguments", "option", "name"),
    [
        ("list S/x --conditions k3 --families ,", "--families", "`"),
        ("build S/x --source sample --only executions --unit 5x5", "--unit", "`unit`"),
        ("build S/manifests --source sample", "BUFFER_SET", "`buffer_set`"),
        ("index S --executor other", "--executor", "executor="),
    ],
)
def test_errors_name_options_and_arguments(
    arguments: str, option: str, name: str, run: Run, own_buffers: Path
) -> None:
    code, _, err = run(*in_buffer_set(arguments, own_buffers))
    assert code != 0 and option in err and name not in err


@pytest.mark.parametrize(
    ("arguments", "code", "kind", "helps"),
    [
        (f"show S {EPISODE} k9", 1, "UnknownNameError", "build S --only manifests"),
        (f"show S {EPISODE} k3 --camera front", 1, "InvalidOptionError", None),
        (f"show S {EPISODE}", 1, "InvalidOptionError", "list S"),
        ("show S", 2, "MissingParameter", None),
        ("list S --nope", 2, "NoSuchOption", None),
    ],
)
def test_errors_as_json(
    arguments: str, code: int, kind: str, helps: str | None, run: Run, own_buffers: Path
) -> None:
    words = in_buffer_set(arguments, own_buffers)
    plain, as_json = run(*words), run(*words, "--json")
    assert (plain[0], as_json[0], as_json[1]) == (code, code, "")
    error = json.loads(as_json[2].splitlines()[-1])
    assert {*error} == {"type", "message", "hint", "command"} and error["type"] == kind
    assert error["message"].splitlines()[0] in plain[2]
    if helps is not None:
        assert helps.replace("S", str(own_buffers)) in error["command"]


def test_a_bug_as_json(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise KeyError("\x9bboom")

    monkeypatch.setattr(doctor, "checks", broken)
    code, out, err = run("doctor", "--json")
    assert (code, out) == (1, "") and "Traceback" in err
    error = json.loads(err.splitlines()[-1])
    assert (error["type"], error["hint"]) == ("KeyError", None)


@pytest.mark.parametrize(
    "arguments",
    [
        f"show S {EPISODE} k3 --out S/demonstrations/meta/strip.png",
        "simulate --family MoveCube --video S/distractors/meta/look.mp4",
        f"retrieve S {EPISODE} k3 --out S/manifests/why.png",
        "retrieval-score S --out S/distractors",
        "evaluate S --policy noop --out S/demonstrations/run",
        "merge a b --out S/manifests/run",
        "score a --out S/distractors/score",
        "score a --out score --export S/demonstrations",
    ],
)
def test_output_inside_a_buffer_set_is_an_error(
    arguments: str, run: Run, own_buffers: Path
) -> None:
    before = contents(own_buffers)
    code, _, err = run(*in_buffer_set(arguments, own_buffers))
    assert code == 1 and f"inside {own_buffers}" in err
    assert contents(own_buffers) == before


# --- list, show, verify, audit -------------------------------------------------------------------


def table_rows(out: str) -> list[list[str]]:
    """The rows under the line below the heads."""
    lines = out[out.index("\n─────") :].splitlines()[2:]
    return [re.split(r"  +", line.strip()) for line in takewhile(str.strip, lines)]


def test_list(run: Run, tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")  # a table is not cut in a narrow terminal
    code, out, err = run("list", tiny_buffers)
    assert (code, err) == (0, "")
    rows = table_rows(out)
    assert len(rows) == 15
    assert rows[8] == [EPISODE, "k3", "easy", "48", "144", "34.4%"]


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        ("--conditions k3 S", 3),  # the buffer set is no condition
        ("S --families MoveCube,PatternLock --conditions k7 --conditions k0", 4),
    ],
)
def test_list_as_json_is_one_value(
    arguments: str, count: int, run: Run, tiny_buffers: Path
) -> None:
    code, out, err = run("list", "--json", *in_buffer_set(arguments, tiny_buffers))
    assert (code, err) == (0, "")
    rows = json.loads(out)
    assert len(rows) == count
    known = [to_dict(manifest) for manifest in load_buffer_set(tiny_buffers).manifests()]
    assert all(row in json.loads(json.dumps(known)) for row in rows)


@pytest.mark.slow
def test_folder_names_that_are_not_utf8(own_buffers: Path) -> None:
    renamed = os.fsencode(own_buffers.parent) + b"/\xff\xfe"
    os.rename(own_buffers, renamed)  # noqa: PTH104
    done = subprocess.run([SCRIPT, "list", renamed], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"VideoRepick/test/0" in done.stdout


def test_show(run: Run, tiny_buffers: Path) -> None:
    code, out, err = run("show", tiny_buffers, EPISODE, "k3")
    assert (code, err) == (0, "")
    assert "watch the video carefully" in out
    rows = table_rows(out)
    assert rows[0] == ["0", "lesson", "MoveCube", EPISODE, "0 to 47"]
    assert [row[4] for row in rows] == ["0 to 47", "48 to 79", "80 to 111", "112 to 143"]
    assert "144 history frames" in out
    assert "34% of an even 32-frame sample" in " ".join(out.split())


def test_show_as_json_and_as_a_picture(run: Run, tiny_buffers: Path, tmp_path: Path) -> None:
    picture = tmp_path / "strip.png"
    code, out, err = run("show", tiny_buffers, EPISODE, "k1", "--out", picture, "--json")
    assert code == 0
    manifest = to_dict(load_buffer_set(tiny_buffers).manifest(EPISODE, "k1"))
    shown = json.loads(out)
    leaves, turns = shown.pop("evidence")
    assert shown == json.loads(json.dumps(manifest))
    expected = {"part": 0, "text": "leaves the left edge", "role": "lesson", "start": 0, "stop": 4}
    assert leaves == expected and turns["part"] == 1
    assert str(picture) in err
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_verify(run: Run, own_buffers: Path) -> None:
    code, out, _ = run("verify", own_buffers, "--json", "--no-decode")
    assert (code, json.loads(out)) == (0, {"violations": []})
    code, out, _ = run("verify", own_buffers, "--json", "--no-decode", "--audit")
    report = json.loads(out)
    assert code == 0 and {*report} == {"violations", "audit", "shortcuts"}
    assert report["audit"]["leaks"] == report["shortcuts"] == []  # the answers are all alike
    assert sum(row["units"] for row in report["audit"]["families"]) == 17
    (video, *_) = sorted(own_buffers.glob("demonstrations/videos/*front/*/*.mp4"))
    video.unlink()
    code, out, err = run("verify", own_buffers, "--no-decode")
    assert code == 1
    assert video.name in out and "Traceback" not in err


# --- control characters ---------------------------------------------------------------------


def test_logged_control_characters_are_escaped(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("robomme_interference_data"), "propagate", True)
    log_to_stderr()
    logger = logging.getLogger("robomme_interference_data.storage.hub")
    logger.info("fetched %s", "\x1b[2Jname")
    logger.debug("not shown")
    assert capsys.readouterr().err == "fetched \\x1b[2Jname\n"


HOSTILE = "\x1b[2J\x9b2J\x1b]0;title\x07"
TO_OBEY = {"\x1b", "\x9b", "\x07"}


@pytest.mark.parametrize(
    "error", [InterferenceError(HOSTILE, HOSTILE), OSError(1, HOSTILE, HOSTILE), KeyError(HOSTILE)]
)
def test_control_characters_in_errors_are_escaped(
    error: Exception, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "robomme_interference_data.cli.main.check_endpoint", Mock(side_effect=error)
    )
    code, out, err = run("conditions")
    assert (code, out) == (1, "")
    assert "[2J" in err and not TO_OBEY & {*err}


def test_control_characters_in_output_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    echo(f"a\n\t{HOSTILE}")
    print_json({"key": HOSTILE})
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == "a"
    assert not TO_OBEY & {*"".join(rest)}
    assert json.loads("\n".join(rest[1:])) == {"key": HOSTILE}  # JSON has escapes of its own


# --- as a program ---------------------------------------------------------------------------------


def test_output_folder_that_cannot_be_created(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "S"
    code, printed, err = run("build", out, "--only", "demonstrations", "--source", "sample")
    assert (code, printed) == (1, "")
    assert f"Error: {out.parent}" in err and "Not a directory" in err
    assert "resume" not in err  # the same command would fail again
    assert "Traceback" not in err


@pytest.mark.slow
def test_closed_stdout(tiny_buffers: Path) -> None:
    """As with `robomme-interference list … | head`."""
    with subprocess.Popen(
        [SCRIPT, "list", tiny_buffers, "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.wait(120) == 1
        assert process.stderr.read() == ""


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


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_an_interrupt_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: tuple[str, ...]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("robomme_interference_data.data.loading.load_buffer_set", interrupted)
    monkeypatch.setattr(sys, "argv", ["robomme-interference", "list", "my-buffers", *options])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capsys.readouterr().err.split() == ["Interrupted."]
