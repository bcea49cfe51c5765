"""Leaderboards: what accepted submissions become, and the page."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import boards
from support.boards import BOARD, SYSTEM, Files
from support.browser import open_page
from support.hub_server import HubServer
from support.messages import raises
from support.scoring import BASE, OWN, RELEASED, RETRIEVAL, ROOT

from robomme_interference_data.errors import FormatError, MissingFileError
from robomme_interference_data.evaluate.leaderboard.entries import (
    BoardStanding,
    Entries,
    PublishedRun,
    read_entries,
)
from robomme_interference_data.evaluate.leaderboard.plain_values import letter
from robomme_interference_data.evaluate.leaderboard.published import Results, ranked_by
from robomme_interference_data.evaluate.leaderboard.site import (
    Leaderboard,
    make_leaderboard,
    write_site,
)

Run = Callable[..., tuple[int, str, str]]
REPOSITORY = "someone/results"


@pytest.fixture
def listed(published_run: Files, board_runs: Path, hub: HubServer, tmp_path: Path) -> Path:
    """A file with two submissions, a control, and results of another program."""
    mine = hub.push(f"datasets/{REPOSITORY}", published_run)
    other = hub.push("datasets/someone/other", boards.published(board_runs / "other"))
    control = {"board": BOARD, "rows": [str(board_runs / "window")], "standing": "control"}
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


def test_training_runs_are_one_system(published_run: Files, hub: HubServer, tmp_path: Path) -> None:
    locations = []
    for seed in range(2):
        files = boards.changed(
            published_run,
            tmp_path / str(seed),
            row=lambda row, seed=seed: row | {"training_seed": seed},
        )
        commit = hub.push(f"datasets/someone/seed-{seed}", files)
        locations.append(f"someone/seed-{seed}@{commit}")
    path = boards.write_board(tmp_path / "results.yaml", boards.submission(*locations))
    made = make_leaderboard(read_entries(path)).to_dict()
    [system] = made["boards"][0]["systems"]
    assert made["refused"] == [] and system["rank"] == 1
    assert system["success"]["k7"]["training_runs"] == len(system["runs"]) == 2


def test_videos_are_linked(published_run: Files, hub: HubServer, tmp_path: Path) -> None:
    def filmed(row: dict[str, Any]) -> dict[str, Any]:
        return row | {"video": "videos/a.mp4"} if row["condition"] == "k7" else row

    files = boards.changed(published_run, tmp_path / "filmed", row=filmed)
    names = {"rows": "rollouts.parquet", "card": "README.md"}
    for more, expected in (({}, names), ({"videos/a.mp4": b""}, {**names, "videos": "videos"})):
        commit = hub.push(f"datasets/{REPOSITORY}", files | more)
        location = f"{REPOSITORY}@{commit}"
        run = PublishedRun(location, "weights", boards.SHA256)
        links = Results(run, Entries(boards=())).links
        page = f"{hub.endpoint}/datasets/{REPOSITORY}"
        assert links == {
            name: f"{page}/{'tree' if name == 'videos' else 'blob'}/{commit}/{path}"
            for name, path in expected.items()
        }


def test_results_of_other_programs_are_not_ranked(
    tmp_path: Path, board_runs: Path, run: Run
) -> None:
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


def test_rows_lie_beside_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in the working directory: the same file must mean the same rows everywhere."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rows.csv").write_text("system\n")
    (tmp_path / "board").mkdir()
    board = {"name": "own", "simulator": "mine"}
    control = {"board": "own", "rows": ["rows.csv"], "standing": "control"}
    path = boards.write_board(tmp_path / "board" / "r.yaml", boards=[board], references=[control])
    with raises(MissingFileError):
        make_leaderboard(read_entries(path))


def test_a_folder_with_an_at_sign_lies_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "results@2026").mkdir()
    entries = Entries(boards=(), folder=tmp_path)
    assert entries.locate("results@2026") == tmp_path / "results@2026"
    assert entries.locate("someone/results@2026") == "someone/results@2026"


def test_boards_may_be_called_as_parts_of_the_page(tmp_path: Path) -> None:
    """The script looks parts up by their ids."""
    made = boards.made_up(tmp_path)
    [board] = made.boards
    for name in ("outcomes", "about"):
        board.board = replace(board.board, name=name)
        write_site(made, tmp_path / name)
        page = (tmp_path / name / "index.html").read_text(encoding="utf-8")
        ids = re.findall(r' id="([^"]*)"', page)
        assert len(ids) == len({*ids})
        assert {*re.findall(r'href="#([^"]*)"', page)} <= {*ids}


def test_an_interrupted_site_lacks_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each file is replaced by its new version; rows of boards that are gone are deleted last.

    Other files stay.
    """
    made = boards.made_up(tmp_path)
    out = tmp_path / "site"
    write_site(made, out)
    rows = (out / "rows" / f"{BOARD}.csv").read_text(encoding="utf-8")
    (out / "rows" / "gone.csv").write_text(rows, encoding="utf-8")
    (out / "rows" / "mine.csv").write_text("my own rows\n")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    replace_file = Path.replace

    def stop(source: Path, target: Path) -> Path:
        if target.parent == out:
            raise KeyboardInterrupt
        return replace_file(source, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "replace", stop)
        write_site(made, out)
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    write_site(made, out)
    assert sorted(path.name for path in out.rglob("*.csv")) == ["mine.csv", f"{BOARD}.csv"]


def test_boards_do_not_mix_simulators(board_runs: Path, tmp_path: Path) -> None:
    board = {"name": BOARD, "simulator": "tabletop"}
    control = {"board": BOARD, "rows": [str(board_runs / "window")], "standing": "control"}
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
