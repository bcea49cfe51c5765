"""The command line: results, exit codes and errors without a traceback; as a program."""

import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from unittest.mock import Mock

import pytest
from support.buffer_sets import QUERIES, contents

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cli import doctor
from robomme_interference_data.cli.console import echo, log_to_stderr, print_json
from robomme_interference_data.cli.main import main
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.schema.codec import to_dict

EPISODE = QUERIES[1]
SCRIPT = Path(sys.executable).with_name("robomme-interference")

Run = Callable[..., tuple[int, str, str]]


def in_buffer_set(arguments: str, buffer_set: Path) -> list[str]:
    """Words of a command line, in which S stands for the buffer set."""
    return [re.sub(r"(^|:)S(?=/|$)", rf"\g<1>{buffer_set}", word) for word in arguments.split()]


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
        "simulate MoveCube/test/0 --video S/distractors/meta/look.mp4",
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


def test_as_a_module_without_what_lies_in_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("raise RuntimeError('planted')")
    command = [sys.executable, "-m", "robomme_interference_data", "--version"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()[0]) == (0, "robomme-interference"), done.stderr


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
