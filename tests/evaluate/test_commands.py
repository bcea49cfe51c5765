"""The commands `evaluate`, `merge` and `ceiling`: arguments, output, progress, how to resume."""

import json
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer
from support.runs import run_one
from support.scoring import STATUS
from support.scoring import row as scored_row
from typer.testing import CliRunner

from robomme_interference_data.cli.merge_command import merge
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate import commands
from robomme_interference_data.evaluate.run import evaluation as run_module
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.progress import RunProgress, estimate, rate_table
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS

pytestmark = pytest.mark.usefixtures("trouble", "_serial")

APP = typer.Typer(rich_markup_mode="markdown", pretty_exceptions_enable=False)
APP.command()(commands.evaluate)
APP.command()(merge)
APP.command()(commands.ceiling)
OWN = "python:support.own_policies:"
USUAL = "--simulator support.worlds:World --system mine --episodes 0"


@pytest.fixture
def _serial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "make_executor", lambda config: Serial())


def type_in(line: str) -> Any:
    return CliRunner().invoke(APP, line.split())


def test_ceiling_prints_a_table_or_json(tiny_buffers: Path) -> None:
    line = f"ceiling {tiny_buffers} --memory window --conditions k0,k1"
    done = type_in(line)
    assert done.exit_code == 0, done.output
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["MoveCube", "k0", "1", "50.0%"] in lines and ["all", "k1", "3", "0.0%"] in lines
    cells = json.loads(type_in(f"{line} --json").stdout)
    assert cells[0] == {
        "part": "VideoRepick",
        "condition": "k0",
        "queries": 1,
        "evidence_kept": 0.5,
        "success": None,
    }


def test_evaluate_writes_the_rows_as_json(tmp_path: Path, tiny_buffers: Path) -> None:
    line = f"evaluate {tiny_buffers} --policy noop {USUAL} --families MoveCube"
    line += " --families VideoRepick --conditions no-history,k1 --json"
    done = type_in(f"{line} --out {tmp_path / 'run'}")
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)
    assert [(row["family"], row["condition"], row["status"]) for row in rows] == [
        (family, condition, "fail")
        for family in ("VideoRepick", "MoveCube")
        for condition in ("no-history", "k1")
    ]


def test_options_of_the_policy_have_types(tmp_path: Path, tiny_buffers: Path) -> None:
    line = f"evaluate {tiny_buffers} --policy {OWN}Still {USUAL} --families MoveCube"
    line += f" --out {tmp_path / 'run'} --policy-option gripper=-1"
    done = type_in(line)
    assert done.exit_code == 0, done.output
    assert "1 of 1 rollouts in" in done.stdout and "0/1 0%" in done.stdout
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["identity"]["policy_options"] == {"gripper": -1}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("max_errors=many", "max_errors is 'many'; expected a whole number, such as max_errors=10"),
        ("cache=2", "cache is 2; expected true or false, such as cache=false"),
        ("max_errors=0", "--set max_errors 0; expected a number above 0"),
        ("max_errors", "NAME=VALUE, such as split=test"),
        ("max_erors=3", "Did you mean 'max_errors'?"),
        ("workers=2", "has an option of its own"),
    ],
)
def test_wrong_settings_are_errors_with_an_example(given: str, words: str) -> None:
    done = type_in(f"evaluate nowhere --policy noop --out run --set {given}")
    assert isinstance(done.exception, InvalidOptionError)
    assert words in str(done.exception)


def test_errors_are_printed_with_the_command_to_resume(
    tmp_path: Path, trouble: Path, tiny_buffers: Path
) -> None:
    (trouble / "MoveCube-0").write_text("raise")
    line = f"evaluate {tiny_buffers} --policy noop {USUAL} --families MoveCube"
    done = type_in(f"{line} --conditions no-history --out {tmp_path / 'run'} --set max_errors=1")
    assert done.exit_code == 1
    assert "1 rollout broke (see" in done.stderr
    assert "Stopped: 1 in a row broke" in done.stderr
    assert done.stderr.rstrip().splitlines()[-1].startswith("robomme-interference")


def test_a_full_disk_names_the_file_and_the_command_to_resume(
    tmp_path: Path, tiny_buffers: Path
) -> None:
    line = f"evaluate {tiny_buffers} --policy {OWN}Filler {USUAL} --families MoveCube --no-probe"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        done = type_in(f"{line} --out {tmp_path / 'run'}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert isinstance(done.exception, OSError)
    assert done.exception.filename == str(tmp_path / "run" / "rollouts.jsonl")
    assert f"Finished rollouts are in {tmp_path / 'run'}" in done.stderr
    assert "resume with:\nrobomme-interference" in done.stderr


@pytest.mark.parametrize("begun", [True, False])
def test_an_interruption_mentions_finished_rollouts_if_there_are_any(
    begun: bool, tmp_path: Path, tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "_write_rows" if begun else "check_shared", stop)
    line = f"evaluate {tiny_buffers} --policy noop {USUAL} --families MoveCube"
    done = type_in(f"{line} --out {tmp_path / 'run'}")
    assert done.exit_code == 130 and "resume with:\nrobomme-interference" in done.stderr
    assert (f"Finished rollouts are in {tmp_path / 'run'}" in done.stderr) == begun


def test_merge_prints_missing_and_duplicate_rollouts(tmp_path: Path) -> None:
    run_one(tmp_path / "a", shard="1/1", conditions=("no-history", "k0"))
    log = tmp_path / "a" / "rollouts.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:1]))
    line = f"merge {tmp_path / 'a'} {tmp_path / 'a'} --out"
    done = type_in(f"{line} {tmp_path / 'merged'}")
    assert done.exit_code == 0, done.output
    assert "1 missing: MoveCube/test/0 under" in done.stderr
    assert "1 in more than one run, the first one kept: MoveCube/test/0" in done.stderr
    assert "1 of 2 rollouts in " in done.stdout
    summary = json.loads(type_in(f"{line} {tmp_path / 'again'} --json").stdout)
    assert (summary["planned"], summary["rows"], len(summary["missing"])) == (2, 1, 1)
    assert summary["missing"][0]["episode"] == "MoveCube/test/0"
    assert summary["conflicts"] == summary["broken"] == []


# --- progress ----------------------------------------------------------------------------------


PLAN = [
    WorkItem(condition, EpisodeId(family, "test", index))
    for family in FAMILIES
    for index in range(50)
    for condition in DEFAULT_CONDITIONS
]


def row(item: WorkItem, status: str) -> Rollout:
    letter = next(letter for letter, name in STATUS.items() if name == status)
    made = scored_row("mine", item.condition, "MoveCube", item.episode.index, letter)
    error = "it \x1b[2Jbroke" if status == "error" else None
    return replace(made, simulator="world", family=item.episode.family, error=error)


def test_nine_families_and_five_conditions_fit_in_80_columns() -> None:
    progress = RunProgress(quiet=True)
    progress.start(PLAN, [row(item, "success") for item in PLAN])
    lines = progress.rates().splitlines()
    assert max(map(len, lines)) <= 80
    for family in FAMILIES:
        (line,) = [line for line in lines if line.startswith(f"{family} ")]
        assert line.split()[1:] == ["50/50", "100%"] * 5


def test_an_estimate_is_printed_once_after_two_rows_of_each_worker(
    capsys: pytest.CaptureFixture[str],
) -> None:
    times = {"reset_s": 10.0, "simulator_s": 60.0, "policy_s": 20.0, "history_s": 5.0}
    with RunProgress(workers=2) as progress:
        progress.start(PLAN[:64], [])
        progress.row(row(PLAN[0], "error"))  # has no times
        for item in PLAN[1:9]:
            progress.row(replace(row(item, "success"), wall_s=100.0, **times))
    (line,) = [one for one in capsys.readouterr().err.splitlines() if "left" in one]
    # 59 of 100 s on two workers are 2,950 s.
    assert line == (
        "about 49 min left; where the time goes: "
        "the simulator 70%, the policy 20%, the history 5%, the rest 5%"
    )


@pytest.mark.parametrize(
    ("simulator", "times", "shares"),
    [
        (
            "recordings",
            {"reset_s": 8.0, "simulator_s": 2.0, "policy_s": 1.0, "history_s": 0.0},
            {"the recordings": 10, "the policy": 1, "the rest": 89},
        ),
        ("world", {"reset_s": 40.0, "policy_s": 60.0}, {"the policy": 60, "the simulator": 40}),
    ],
)
def test_an_estimate_shares_out_the_whole_time(
    simulator: str, times: dict[str, float], shares: dict[str, int]
) -> None:
    rows = [replace(row(PLAN[0], "success"), simulator=simulator, wall_s=100.0, **times)]
    _, _, told = estimate(rows, left=10, workers=1).partition("goes: ")
    found = {
        part: int(share[:-1]) for part, _, share in (s.rpartition(" ") for s in told.split(", "))
    }
    assert found == shares and sum(found.values()) == 100


def test_a_run_that_ends_within_seconds_has_no_estimate() -> None:
    rows = [replace(row(PLAN[0], "success"), wall_s=1.0, policy_s=1.0)]
    assert estimate(rows, left=59, workers=1) == "" != estimate(rows, left=60, workers=1)


def test_errors_are_listed_beside_the_rate() -> None:
    items = [item for item in PLAN if item.condition == "k0"][:7]
    ends = ("success", "fail", "success", "timeout", "success", "error")
    rows = [row(item, end) for item, end in zip(items, ends, strict=False)]
    other = WorkItem("no-history", EpisodeId("MoveCube", "test", 0))
    table = rate_table([*rows, row(other, "error")])
    assert [*table.columns] == ["family", "no-history", "k0"]
    assert tuple(table.rows) == (
        ("VideoRepick", "", "3/5 60%, 1 broke"),
        ("MoveCube", "1 broke", ""),
        ("all", "1 broke", "3/5 60%, 1 broke"),
    )


def test_without_a_terminal_each_cell_prints_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    plan = [WorkItem(c, EpisodeId("MoveCube", "test", 0)) for c in ("no-history", "k0", "k1")]
    with RunProgress() as progress:
        progress.start(plan, [row(plan[0], "fail")])
        progress.row(row(plan[1], "success"))
        progress.row(row(plan[2], "error"))
    assert capsys.readouterr().err.splitlines() == [
        "1 of 3 rollouts are already done",
        "MoveCube k0: 1/1 100%  (2 of 3)",
        r"MoveCube/test/0 under k1 broke: it \x1b[2Jbroke",
        "MoveCube k1: 1 broke  (3 of 3)",
    ]
