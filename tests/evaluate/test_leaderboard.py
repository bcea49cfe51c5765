"""Leaderboards: twelve rules, each broken once, and what accepted submissions become."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from support import boards
from support.boards import BOARD, SYSTEM, Files
from support.browser import open_page
from support.hub_server import HubServer
from support.messages import raises
from support.scoring import BASE, OWN, RELEASED, RETRIEVAL, ROOT

from robomme_interference_data.errors import FormatError, InvalidOptionError
from robomme_interference_data.evaluate.leaderboard.entries import (
    BoardStanding,
    PublishedRun,
    Submission,
    add_submission,
    read_entries,
)
from robomme_interference_data.evaluate.leaderboard.plain_values import letter
from robomme_interference_data.evaluate.leaderboard.published import RATES, Results, ranked_by
from robomme_interference_data.evaluate.leaderboard.rules import RULES
from robomme_interference_data.evaluate.leaderboard.site import (
    Leaderboard,
    check_all,
    make_leaderboard,
    write_site,
)

Run = Callable[..., tuple[int, str, str]]
REPOSITORY = "someone/results"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Runs of three policies: one to submit, one with another memory, and a control."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        boards.use_tiny(patch)
        boards.make_run(folder / "mine", "replay:framesamp", SYSTEM)
        boards.make_run(folder / "other", "replay:full", "other-memory")
        boards.make_run(folder / "window", "replay:window", "replay-window", no_probe=True)
    yield folder


@pytest.fixture(scope="module")
def good(made: Path) -> Files:
    return boards.published(made / "mine")


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

ALSO = {1: {11}}
"""Rows of another protocol cannot be scored either."""


@pytest.mark.parametrize("number", BAD)
def test_each_rule_is_broken_once(number: int, good: Files, hub: HubServer, tmp_path: Path) -> None:
    files, stated = BAD[number](good, tmp_path / "bad")
    commit = hub.push(f"datasets/{REPOSITORY}", files)
    results = f"{REPOSITORY}@{stated.pop('commit', commit)}"
    entry = boards.submission(*[results] * stated.pop("runs", 1), **stated)
    path = boards.write_board(tmp_path / "results.yaml", entry)
    problems = check_all(read_entries(path))
    assert {problem.rule.number for problem in problems} == {number} | ALSO.get(number, set())


def test_what_is_not_accepted_is_listed(
    good: Files, hub: HubServer, tmp_path: Path, run: Run
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", good)
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
    ],
)
def test_what_the_hub_does_not_have(
    location: str, part: str, good: Files, hub: HubServer, tmp_path: Path
) -> None:
    hub.push(f"datasets/{REPOSITORY}", good)
    entry = boards.submission(location, checkpoint_sha256="abc")
    problems = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    # What needs no rows is checked at once.
    assert [problem.rule.number for problem in problems] == [9, 10]
    assert part in problems[0].what


@pytest.mark.parametrize("name", ["rollouts.parquet", RATES, "README.md"])
@pytest.mark.parametrize("data", [b"", b"nothing of it", b"\xff\x00,"])
def test_damaged_files_of_a_repository(
    name: str, data: bytes, good: Files, hub: HubServer, tmp_path: Path
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", good | {name: data})
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    problems = check_all(read_entries(boards.write_board(tmp_path / "results.yaml", entry)))
    assert {problem.rule.number for problem in problems} == {11}


def test_names_are_unique_on_a_board(
    good: Files, made: Path, hub: HubServer, tmp_path: Path
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", good)
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    path = boards.write_board(tmp_path / "results.yaml", entry, entry)
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [12]
    control = {"board": BOARD, "rows": [str(made / "mine")], "standing": "control"}
    path = boards.write_board(tmp_path / "results.yaml", entry, references=[control])
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [12]


def test_a_policy_that_knows_the_answer_is_no_submission(
    good: Files, hub: HubServer, tmp_path: Path
) -> None:
    def privileged(header: dict[str, Any]) -> dict[str, Any]:
        header["invocations"][0]["policy"]["privileged"] = True
        return header

    files = boards.changed(good, tmp_path / "bad", header=privileged)
    commit = hub.push(f"datasets/{REPOSITORY}", files)
    path = boards.write_board(
        tmp_path / "results.yaml", boards.submission(f"{REPOSITORY}@{commit}")
    )
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [12]


def test_a_board_without_a_buffer_set_takes_no_submission(
    good: Files, hub: HubServer, tmp_path: Path
) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", good)
    board = {"name": BOARD, "simulator": "support.worlds:World"}
    entry = boards.submission(f"{REPOSITORY}@{commit}")
    path = boards.write_board(tmp_path / "results.yaml", entry, boards=[board])
    assert [problem.rule.number for problem in check_all(read_entries(path))] == [2]


# --- what is accepted ----------------------------------------------------------------------------


@pytest.fixture
def listed(good: Files, made: Path, hub: HubServer, tmp_path: Path) -> Path:
    """A file with two submissions, a control, and results of another program."""
    mine = hub.push(f"datasets/{REPOSITORY}", good)
    other = hub.push("datasets/someone/other", boards.published(made / "other"))
    control = {"board": BOARD, "rows": [str(made / "window")], "standing": "control"}
    return boards.write_board(
        tmp_path / "results.yaml",
        boards.submission(f"{REPOSITORY}@{mine}", parameters=1300000, trained_on="interference"),
        boards.submission(f"someone/other@{other}", system="other-memory"),
        references=[control],
    )


def test_a_leaderboard(listed: Path, hub: HubServer, tmp_path: Path, run: Run) -> None:
    assert run("submit", listed, "--check")[0] == 0
    code, out, err = run("leaderboard", listed, "--out", tmp_path / "site")
    assert code == 0, err
    assert out == f"{BOARD}: 2 ranked, 1 beside them\n"
    text = (tmp_path / "site" / "leaderboard.json").read_text(encoding="utf-8")
    [board] = json.loads(text)["boards"]
    by_name = {system["system"]: system for system in board["systems"]}
    assert board["ranked_by"] == "k7" and len(board["episodes"]) == 3
    # Three episodes decide nothing: both submissions are tied.
    for name in (SYSTEM, "other-memory"):
        system = by_name[name]
        assert (system["rank_low"], system["rank_high"], system["tied"]) == (1, 2, True)
        assert set(system["success"]) == {"no-history", "k0", "k1", "k3", "k7"}
        assert set(system["differences"]) == {"replay-window"}
    control = by_name["replay-window"]
    assert (control["standing"], control["rank"]) == ("control", None)
    assert by_name[SYSTEM]["trained_on"] == "interference"
    link = by_name[SYSTEM]["runs"][0]["links"]["rows"]
    assert link.startswith(f"{hub.endpoint}/datasets/{REPOSITORY}/blob/")
    for system in board["systems"]:
        for condition, letters in system["outcomes"].items():
            rate = system["success"][condition]["rate"]
            assert letters.count("s") / 3 == pytest.approx(rate, abs=1e-6)
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "<script src" not in page and 'rel="stylesheet"' not in page
    rows = (tmp_path / "site" / "rows" / f"{BOARD}.csv").read_text(encoding="utf-8")
    assert len(rows.splitlines()) == 1 + 3 * 15
    before = {path: path.read_bytes() for path in (tmp_path / "site").rglob("*") if path.is_file()}
    assert run("leaderboard", listed, "--out", tmp_path / "site")[0] == 0
    assert before == {path: path.read_bytes() for path in before}


def test_training_runs_are_one_system(good: Files, hub: HubServer, tmp_path: Path) -> None:
    locations = []
    for seed in range(2):
        files = boards.changed(
            good, tmp_path / str(seed), row=lambda row, seed=seed: row | {"training_seed": seed}
        )
        commit = hub.push(f"datasets/someone/seed-{seed}", files)
        locations.append(f"someone/seed-{seed}@{commit}")
    path = boards.write_board(tmp_path / "results.yaml", boards.submission(*locations))
    made = make_leaderboard(read_entries(path)).to_dict()
    [system] = made["boards"][0]["systems"]
    assert made["refused"] == [] and system["rank"] == 1
    assert system["success"]["k7"]["training_runs"] == len(system["runs"]) == 2


def test_videos_are_linked(good: Files, hub: HubServer, tmp_path: Path) -> None:
    def filmed(row: dict[str, Any]) -> dict[str, Any]:
        return row | {"video": "videos/a.mp4"} if row["condition"] == "k7" else row

    files = boards.changed(good, tmp_path / "filmed", row=filmed)
    names = {"rows": "rollouts.parquet", "card": "README.md"}
    for more, expected in (({}, names), ({"videos/a.mp4": b""}, {**names, "videos": "videos"})):
        commit = hub.push(f"datasets/{REPOSITORY}", files | more)
        location = f"{REPOSITORY}@{commit}"
        links = Results(PublishedRun(location, "weights", boards.SHA256), location).links
        page = f"{hub.endpoint}/datasets/{REPOSITORY}"
        assert links == {
            name: f"{page}/{'tree' if name == 'videos' else 'blob'}/{commit}/{path}"
            for name, path in expected.items()
        }


def test_results_of_other_programs_are_not_ranked(tmp_path: Path, made: Path, run: Run) -> None:
    tasks = [{"task_group": "libero", "task_id": 0, "metrics": {"successes": [True, False]}}]
    (tmp_path / "eval_info.json").write_text(json.dumps({"per_task": tasks}))
    board = {"name": "libero", "simulator": "libero"}
    reference = {
        "board": "libero",
        "rows": ["eval_info.json"],
        "standing": "unverified",
        "system": "act",
    }
    path = boards.write_board(tmp_path / "results.yaml", boards=[board], references=[reference])
    made_board = make_leaderboard(read_entries(path)).to_dict()["boards"][0]
    [system] = made_board["systems"]
    assert (system["system"], system["standing"], system["rank"]) == ("act", "unverified", None)
    assert system["outcomes"] == {"no-history": "sf"}


def test_boards_do_not_mix_simulators(made: Path, tmp_path: Path) -> None:
    board = {"name": BOARD, "simulator": "tabletop"}
    control = {"board": BOARD, "rows": [str(made / "window")], "standing": "control"}
    path = boards.write_board(tmp_path / "results.yaml", boards=[board], references=[control])
    with raises(FormatError):
        make_leaderboard(read_entries(path))


def test_the_condition_of_the_ranks() -> None:
    assert ranked_by(("no-history", "k0", "k7", "k31")) == "k7"
    assert ranked_by(("no-history", "k0", "k3", "raw-k7")) == "k3"
    assert ranked_by(("day-k4", "day-k8", "day-alone")) == "day-k8"


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ((1, 0, 0, 0, 0), "s"),
        ((0, 1, 0, 0, 0), "f"),
        ((0, 0, 2, 0, 0), "t"),
        ((0, 1, 1, 0, 0), "f"),
        ((0, 0, 0, 1, 0), "e"),
        ((0, 0, 0, 0, 0), "-"),
        ((2, 1, 0, 0, 0), "7"),
        ((1, 0, 0, 1, 0), "s"),
    ],
)
def test_letters(counts: tuple[int, ...], expected: str) -> None:
    assert letter(counts) == expected


def test_the_written_json(tmp_path: Path) -> None:
    """Rates, ranks, ties and differences of made-up rows, which `test_ranks.py` works out."""
    made = boards.made_up(tmp_path)
    data = write_site(made, tmp_path / "site")
    written = (tmp_path / "site" / "leaderboard.json").read_text(encoding="utf-8")
    assert written == boards.GOLDEN_JSON.read_text(encoding="utf-8")
    assert json.loads(written) == data
    [board] = data["boards"]
    [first, second, *_] = board["systems"]
    # 7 and 2 of 12: five episodes gained and none lost are p = 1/16 by McNemar's exact test.
    assert [each["success"]["k7"]["rate"] for each in (first, second)] == [0.583333, 0.166667]
    assert [(each["rank_low"], each["rank_high"]) for each in (first, second)] == [(1, 2), (1, 2)]
    assert board["controls"] == {"guess": "no-history"}
    assert first["outcomes"]["k7"] == "sssssfssffft"
    # 7 of 12 against 1: the guess fails wherever the system fails.
    difference = first["differences"]["guess"]
    assert (difference["n"], difference["value"]) == (12, 0.5)


def test_differences_stand_below_their_control(tmp_path: Path) -> None:
    [board] = boards.made_up(tmp_path).boards
    shown = {**board.shown, OWN: replace(board.shown[OWN], standing=BoardStanding.CONTROL)}
    board.shown = {name: shown[name] for name in (OWN, "guess", RETRIEVAL, BASE)}
    data = write_site(Leaderboard((board,), ()), tmp_path / "site")
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    table = page[page.index("Differences to the controls") :]
    table = table[: table.index("</table>")]
    heads = re.findall(r'<button type="button">([^<]*)</button>', table)
    rows = [re.findall(r'data-value="([^"]*)"', row) for row in table.split("<tr>")[2:]]
    names = {system["name"]: system for system in data["boards"][0]["systems"]}
    assert len(heads) == 3 and len(rows) == 2
    for row, name in zip(rows, re.findall(r'<th scope="row">([^<]*)</th>', table), strict=True):
        for value, head in zip(row, heads[1:], strict=True):
            expected = names[name]["differences"][names[head]["system"]]["value"]
            assert float(value) == expected


@pytest.mark.slow
def test_the_leaderboard_of_this_repository(tmp_path: Path, run: Run) -> None:
    """Its rows break rules 2 and 6, so all are references."""
    path = ROOT / "docs" / "leaderboard" / "results.yaml"
    words = ["leaderboard", path, "--out", tmp_path]
    if RELEASED.exists():
        words += ["--released", RELEASED]
    code, _, err = run(*words)
    assert code == 0, err
    data = json.loads((tmp_path / "leaderboard.json").read_text(encoding="utf-8"))
    assert data["refused"] == []
    boards_by_name = {board["board"]: board for board in data["boards"]}
    assert [*boards_by_name] == ["robomme", "tabletop", "tabletop-training", "questions"]
    for board in data["boards"]:
        assert {system["rank"] for system in board["systems"]} == {None}
    # docs/results/training.md: 5.1% trained on lessons alone, 64.7% with interference.
    rates = {
        system["system"]: (system["trained_on"], round(system["success"]["k7"]["rate"], 3))
        for system in boards_by_name["tabletop-training"]["systems"]
    }
    assert rates["acts-k0"] == ("other", 0.051)
    assert rates["acts-mixture"] == ("interference", 0.647)
    standings = {
        system["system"]: system["standing"] for system in boards_by_name["robomme"]["systems"]
    }
    assert standings["oracle"] == "control"
    if RELEASED.exists():
        assert standings["retrieval-framesamp-modul"] == "paper"


@pytest.mark.slow
def test_the_page_in_a_browser(tmp_path: Path) -> None:
    made = boards.made_up(tmp_path)
    note = "<script>document.title = 'bad'</script>"
    made.boards[0].board = replace(made.boards[0].board, note=note)
    write_site(made, tmp_path / "site")
    page_file = tmp_path / "site" / "index.html"
    with open_page() as page:
        for width in (390, 1280):
            page.events.clear()
            page.call(
                "Emulation.setDeviceMetricsOverride",
                width=width,
                height=800,
                deviceScaleFactor=1,
                mobile=width < 500,
            )
            page.open(page_file)
            assert page.requests() == [page_file.resolve().as_uri()] and not page.complaints()
            assert page.run("document.documentElement.scrollWidth") <= width
            assert page.run("document.title") == "RoboMME-Interference: leaderboard"
        names = "[...document.querySelectorAll('#table-tiny tbody th')].map(e => e.textContent)"
        first = page.run(names)
        assert first[0] == "Retrieval-FrameSamp-Modul" and len(first) == 4
        # The second column of rates is that of no-history; the best of it is at the end.
        page.click("#table-tiny thead th:nth-child(5) button")
        assert page.run(names)[:2] != first[:2]
        page.choose("#table-tiny select[name='standing']", "control")
        assert page.run(names) == ["Guess"]
        rows = "document.querySelectorAll('#picture-tiny canvas').length"
        assert page.run(rows) == 2  # that ran k7
        widths = "document.querySelector('#picture-tiny canvas').clientWidth"
        whole = page.run(widths)
        page.run(
            "{ const e = document.querySelector('#picture-tiny select[name=family]');"
            "e.value = 'MoveCube'; e.dispatchEvent(new Event('input')); }"
        )
        assert page.run(widths) < whole
        page.run(
            "{ const e = document.querySelector('#picture-tiny select[name=condition]');"
            "e.value = 'no-history'; e.dispatchEvent(new Event('input')); }"
        )
        assert page.run(rows) == 3
        # Each column of differences is that of its control.
        heads = "[...document.querySelectorAll('h3 + section thead th')].map(e => e.textContent)"
        assert page.run(heads)[:2] == ["system", "Guess"]


# --- the command that adds a submission ----------------------------------------------------------


def test_submit(good: Files, hub: HubServer, tmp_path: Path, run: Run) -> None:
    commit = hub.push(f"datasets/{REPOSITORY}", good, "data-1.0.0")
    path = boards.write_board(tmp_path / "results.yaml")
    before = path.read_text(encoding="utf-8")
    (tmp_path / "policy.py").write_text("pass\n")
    words = ["submit", path, "--results", f"{REPOSITORY}@data-1.0.0", "--memory", "frames"]
    code, _, err = run(*words)
    assert code == 1
    for option in ("--checkpoint", "--weights", "--trained-on"):
        assert option in err
    words += ["--checkpoint", "someone/model", "--weights", tmp_path / "policy.py"]
    words += ["--trained-on", "nothing"]
    code, _, err = run(*words, "--check")
    assert code == 0 and path.read_text(encoding="utf-8") == before, err
    code, _, err = run(*words)
    assert code == 0, err
    [added] = yaml.safe_load(path.read_text(encoding="utf-8"))["submissions"]
    assert (added["system"], added["board"]) == (SYSTEM, BOARD)
    assert added["runs"][0]["results"] == f"{REPOSITORY}@{commit}"
    assert len(added["runs"][0]["checkpoint_sha256"]) == 64
    assert run("submit", path, "--check")[0] == 0
    # The same name a second time.
    after = path.read_text(encoding="utf-8")
    assert run(*words)[0] == 1 and path.read_text(encoding="utf-8") == after
    assert run("submit", path)[0] == 1


ENTRY = Submission(
    system="mine",
    board=BOARD,
    memory="none",
    trained_on="other",
    runs=(PublishedRun("a/b@" + "0" * 40, "weights", "ab" * 32),),
    contact="me: @example",
)


@pytest.mark.parametrize("end", ["submissions:\n", "submissions: []\n", "submissions: [] ", ""])
def test_an_entry_is_added_at_the_end(tmp_path: Path, end: str) -> None:
    path = tmp_path / "results.yaml"
    head = f"# Kept.\nboards:\n- name: {BOARD}  # as it is\n  simulator: tabletop\n"
    path.write_text(head + end)
    for number in range(1, 3):
        add_submission(path, ENTRY)
        assert read_entries(path).submissions == (ENTRY,) * number
        assert path.read_text().startswith(head)


def test_an_entry_is_not_added_in_the_middle(tmp_path: Path) -> None:
    path = tmp_path / "results.yaml"
    text = f"submissions: []\nboards:\n- name: {BOARD}\n  simulator: tabletop\n"
    path.write_text(text)
    with raises(InvalidOptionError):
        add_submission(path, ENTRY)
    assert path.read_text() == text


WRONG_FIELDS = (
    "boards: 3",
    "boards:\n- name: a",
    "boards:\n- name: a\n  simulator: b\n  more: c",
    "boards: []\nreferences:\n- {board: a, rows: [b], standing: submission}",
    "boards: []\nother: 1",
)


def test_the_json_schema() -> None:
    schema = json.loads(boards.SCHEMA.read_text(encoding="utf-8"))
    assert schema == boards.json_schema()
    jsonschema = pytest.importorskip("jsonschema")
    check = jsonschema.Draft202012Validator(schema)
    whole = yaml.safe_load((ROOT / "docs" / "leaderboard" / "results.yaml").read_text("utf-8"))
    assert check.is_valid(whole)
    assert check.is_valid({**whole, "submissions": [boards.submission("a/b@" + "0" * 40)]})
    assert not check.is_valid({**whole, "submissions": [boards.submission("a", memory="good")]})
    assert not any(check.is_valid(yaml.safe_load(text)) for text in WRONG_FIELDS)


@pytest.mark.parametrize(
    "text",
    [
        *WRONG_FIELDS,
        "boards: [",
        "- a",
        "boards:\n- {name: a b, simulator: c}",
        "boards: 2026-13-45",
        "boards: 0001-01-01T00:00:00+23:59",
        "boards: &x [*x]",
        "? [a]\n: b",
        pytest.param("[" * 5000, id="deep"),
        "boards:\n- &a {name: a, simulator: b}\n- *a",
        "boards: []\nreferences:\n- {board: a, rows: [b], standing: control}",
    ],
)
def test_a_wrong_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "results.yaml"
    path.write_text(text)
    with raises(FormatError):
        read_entries(path)
