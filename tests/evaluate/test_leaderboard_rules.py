"""The twelve rules of a leaderboard, each broken once, and ways around them."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support import boards, runs
from support.boards import BOARD, Files
from support.buffer_sets import GOLDEN
from support.hub_server import HubServer
from support.messages import raises

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD
from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.leaderboard.checks import few_errors
from robomme_interference_data.evaluate.leaderboard.entries import read_entries
from robomme_interference_data.evaluate.leaderboard.published import RATES
from robomme_interference_data.evaluate.leaderboard.rules import RULES
from robomme_interference_data.evaluate.leaderboard.site import check_all, make_leaderboard

Run = Callable[..., tuple[int, str, str]]
REPOSITORY = "someone/results"


Broken = tuple[Files, dict[str, Any]]
"""Files of a repository, and what its entry states otherwise."""


def with_rows(files: Files, folder: Path, **values: Any) -> Broken:
    return boards.changed(files, folder, row=lambda row: row | values), {}


def incomplete(files: Files, folder: Path) -> Broken:
    def without(row: dict[str, Any]) -> dict[str, Any]:
        return {} if (row["family"], row["condition"]) == ("MoveCube", "k7") else row

    return boards.changed(files, folder, row=without), {}


def broken_rollouts(files: Files, folder: Path) -> Broken:
    def broken(row: dict[str, Any]) -> dict[str, Any]:
        error = {"status": "error", "success": None, "error": "it broke"}
        return row | error if row["condition"] == "k7" else row

    return boards.changed(files, folder, row=broken), {}


def with_probe(files: Files, folder: Path, probe: dict[str, Any] | None) -> Broken:
    def other(header: dict[str, Any]) -> dict[str, Any]:
        return header | {"probe": None if probe is None else header["probe"] | probe}

    return boards.changed(files, folder, header=other), {}


def shorter_histories(files: Files, folder: Path) -> Broken:
    def shorter(row: dict[str, Any]) -> dict[str, Any]:
        return row | {"history_frames": max(row["history_frames"] - 1, 0)}

    return boards.changed(files, folder, row=shorter), {}


def other_rates(files: Files, folder: Path) -> Broken:
    text = files[RATES].decode().replace(",0.000000,", ",0.900000,").replace(",1.000000,", ",0.9,")
    return files | {RATES: text.encode()}, {}


BAD: dict[int, Callable[[Files, Path], Broken]] = {
    1: lambda files, folder: with_rows(files, folder, protocol_version=2),
    2: lambda files, folder: with_rows(files, folder, revision="cd" * 32),
    3: incomplete,
    4: lambda files, folder: (files, {"runs": 2}),
    5: broken_rollouts,
    6: lambda files, folder: with_probe(files, folder, None),
    7: lambda files, folder: with_probe(
        files, folder, {"verdict": "broken", "error": "the server left"}
    ),
    8: shorter_histories,
    9: lambda files, folder: (files, {"commit": "main"}),
    10: lambda files, folder: (files, {"checkpoint_sha256": "abc"}),
    11: other_rates,
    12: lambda files, folder: (files, {"memory": "none"}),
}
"""How each rule is broken, by number."""


def unread_and_incomplete(files: Files, folder: Path) -> Broken:
    def other(row: dict[str, Any]) -> dict[str, Any]:
        lacking = (row["family"], row["condition"]) == ("MoveCube", "k7")
        return {} if lacking else row | {"reads_history": False}

    return boards.changed(files, folder, row=other), {"memory": "none"}


def unread_under_k7_alone(files: Files, folder: Path) -> Broken:
    def other(row: dict[str, Any]) -> dict[str, Any]:
        kept = row["condition"] in ("no-history", "k7")
        return row | {"reads_history": False, "memory": None} if kept else {}

    return boards.changed(files, folder, row=other), {"memory": "none"}


def invented(files: Files) -> bytes:
    """A line of the stated rates under a condition that no row has."""
    lines = files[RATES].decode().splitlines()
    [line] = [line for line in lines if ",k7," in line]
    return f"{line.replace(',k7,', ',k31,')}\n".encode()


def edited_probe(files: Files, **values: Any) -> Files:
    header = json.loads(files[RUN_HEADER])
    header["probe"] |= values
    return files | {RUN_HEADER: json.dumps(header).encode()}


AROUND: list[tuple[int, Callable[[Files, Path], Broken]]] = [
    (3, unread_and_incomplete),
    (3, unread_under_k7_alone),
    (9, lambda files, _: (edited_probe(files, verdict="nondeterministic"), {})),
    (9, lambda files, _: (edited_probe(files, verdict="fine"), {})),
    (11, lambda files, _: (files | {RATES: files[RATES] + invented(files)}, {})),
]
"""Ways around rules: rows that deny to read the history, an edited probe, an invented rate."""

ALSO = {1: {11}}
"""Rows of another protocol cannot be scored either."""


@pytest.mark.parametrize("number", BAD)
def test_each_rule_is_broken_once(
    number: int, published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    files, stated = BAD[number](published_run, tmp_path / "bad")
    commit = hub.push(f"datasets/{REPOSITORY}", files)
    results = f"{REPOSITORY}@{stated.pop('commit', commit)}"
    entry = boards.submission(*[results] * stated.pop("runs", 1), **stated)
    path = boards.write_board(tmp_path / "results.yaml", entry)
    problems = check_all(read_entries(path))
    assert {problem.rule.number for problem in problems} == {number} | ALSO.get(number, set())


@pytest.mark.parametrize(("number", "broken"), AROUND)
def test_ways_around_a_rule(
    number: int,
    broken: Callable[[Files, Path], Broken],
    published_run: Files,
    hub: HubServer,
    tmp_path: Path,
) -> None:
    files, stated = broken(published_run, tmp_path / "bad")
    commit = hub.push(f"datasets/{REPOSITORY}", files)
    entry = boards.submission(f"{REPOSITORY}@{commit}", **stated)
    problems = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    assert number in {problem.rule.number for problem in problems}


def test_errors_count_under_each_condition() -> None:
    """Of 450 rollouts under k7, 5 broke: 1.1%, though they are 0.3% of all."""

    def rows(condition: str, status: str, count: int) -> list[Any]:
        made = SimpleNamespace(condition=condition, status=status, episode_id="a", error="it broke")
        return [made] * count

    case: Any = SimpleNamespace(
        rows=[*rows("k0", "success", 1350), *rows("k7", "success", 445), *rows("k7", "error", 5)]
    )
    assert len([*few_errors(case)]) == 1
    case.rows[-1] = case.rows[0]
    assert [*few_errors(case)] == []


def test_a_board_on_the_hub_takes_no_folder(
    published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    files = {
        path.relative_to(GOLDEN).as_posix(): path.read_bytes()
        for path in GOLDEN.rglob("*")
        if path.is_file()
    }
    commit = hub.push("datasets/someone/tiny", files)
    for name, data in published_run.items():
        path = tmp_path / "folder" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    entry = boards.submission("folder")
    for location, numbers in ((str(GOLDEN), []), (f"someone/tiny@{commit}", [9])):
        board = {"name": BOARD, "simulator": runs.WORLD, "buffer_set": location}
        path = boards.write_board(tmp_path / "results.yaml", entry, boards=[board])
        assert [problem.rule.number for problem in check_all(read_entries(path))] == numbers


def test_a_submission_that_contradicts_the_board_does_not_stop_it(
    published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    entries = []
    for number, chance in enumerate((0.25, 0.5)):
        system = f"memory-{number}"
        files = boards.changed(
            published_run,
            tmp_path / system,
            row=lambda row, system=system, chance=chance: (
                row | {"system": system, "chance": chance}
            ),
        )
        commit = hub.push(f"datasets/someone/{system}", files)
        entries.append(boards.submission(f"someone/{system}@{commit}", system=system))
    path = boards.write_board(tmp_path / "results.yaml", *entries)
    made = make_leaderboard(read_entries(path)).to_dict()
    [refused] = made["refused"]
    assert refused["system"] == "memory-1" and "chance" in refused["what"]
    assert [system["system"] for system in made["boards"][0]["systems"]] == ["memory-0"]


def test_what_is_not_accepted_is_listed(
    published_run: Files, hub: HubServer, tmp_path: Path, run: Run
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", published_run)
    entry = boards.submission(f"{REPOSITORY}@{commit}", checkpoint_sha256="abc", memory="none")
    path = boards.write_board(tmp_path / "results.yaml", entry)
    problems = check_all(read_entries(path))
    assert [problem.rule.number for problem in problems] == [10, 12]
    for words in (("submit", path, "--check"), ("leaderboard", path, "--out", tmp_path / "site")):
        code, out, err = run(*words)
        assert (code, out) == (int(words[0] == "submit"), "")
        assert all(str(problem) in err and problem.rule.fix in err for problem in problems)
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "Not accepted" in page
    refused = json.loads((tmp_path / "site" / "leaderboard.json").read_text())["refused"]
    assert [problem["rule"] for problem in refused] == [10, 12]


def test_rules_are_twelve() -> None:
    assert [rule.number for rule in RULES] == list(range(1, 13)) == sorted(BAD)


@pytest.mark.parametrize(
    ("location", "part"),
    [
        ("someone/nothing@" + "0" * 40, "does not exist"),
        (f"{REPOSITORY}@" + "0" * 40, "no revision"),
        (f"{REPOSITORY}@data-1.0.0", "40 digits"),
        (REPOSITORY, "there is no folder"),
        ("results.yaml", "there is no folder"),
    ],
)
def test_what_is_not_there(
    location: str, part: str, published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    hub.push(f"datasets/{REPOSITORY}", published_run)
    entry = boards.submission(location, checkpoint_sha256="abc")
    problems = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    # What needs no rows is checked at once.
    assert [problem.rule.number for problem in problems] == [9, 10]
    assert part in problems[0].what


def test_a_board_names_the_commit_of_its_buffer_set(tmp_path: Path) -> None:
    board = {"name": BOARD, "simulator": "tabletop", "buffer_set": "someone/set@main"}
    with raises(FormatError):
        check_all(read_entries(boards.write_board(tmp_path / "results.yaml", boards=[board])))


def test_weights_are_not_empty(published_run: Files, hub: HubServer, tmp_path: Path) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", published_run)
    nothing = hashlib.sha256(b"").hexdigest()
    entry = boards.submission(f"{REPOSITORY}@{commit}", checkpoint_sha256=nothing)
    [problem] = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    assert problem.rule.number == 10


@pytest.mark.parametrize("name", ["rollouts.parquet", RATES, "README.md"])
@pytest.mark.parametrize("data", [b"", b"nothing of it", b"\xff\x00,", b"a" * 200_000])
def test_damaged_files_of_a_repository(
    name: str, data: bytes, published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", published_run | {name: data})
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    problems = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    assert {problem.rule.number for problem in problems} == {11}


@pytest.mark.parametrize("change", [{"family": "<b>"}, {"split": "all"}, {"episode": -1}])
def test_rows_of_no_episode(
    change: dict[str, Any], published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    """They do not stop the board, and the submission is named."""
    *lines, last = published_run[RUN_RECORD].decode().splitlines()
    lines.append(json.dumps(json.loads(last) | change))
    files = published_run | {RUN_RECORD: "\n".join(lines).encode() + b"\n"}
    commit = hub.push(f"datasets/{REPOSITORY}", files)
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    [problem] = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    assert problem.rule.number == 9 and f"line {len(lines)} is no row" in problem.what


def test_names_are_unique_on_a_board(
    published_run: Files, board_runs: Path, hub: HubServer, tmp_path: Path
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", published_run)
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    path = boards.write_board(tmp_path / "results.yaml", entry, entry)
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [12]
    control = {"board": BOARD, "rows": [str(board_runs / "mine")], "standing": "control"}
    path = boards.write_board(tmp_path / "results.yaml", entry, references=[control])
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [12]


def test_a_policy_that_knows_the_answer_is_no_submission(
    published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    def privileged(header: dict[str, Any]) -> dict[str, Any]:
        header["invocations"][0]["policy"]["privileged"] = True
        return header

    files = boards.changed(published_run, tmp_path / "bad", header=privileged)
    commit = hub.push(f"datasets/{REPOSITORY}", files)
    path = boards.write_board(
        tmp_path / "results.yaml", boards.submission(f"{REPOSITORY}@{commit}")
    )
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [12]


def test_a_board_without_a_buffer_set_takes_no_submission(
    published_run: Files, hub: HubServer, tmp_path: Path
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", published_run)
    board = {"name": BOARD, "simulator": "support.worlds:World"}
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    path = boards.write_board(tmp_path / "results.yaml", entry, boards=[board])
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [2]
