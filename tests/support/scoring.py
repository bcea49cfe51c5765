"""Made-up rollout rows for the tests of scoring: few enough to be worked out by hand."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import typer
from typer.testing import CliRunner

from robomme_interference_data.evaluate.run.record import RunHeader
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score import commands
from robomme_interference_data.evaluate.score.config import Against, Expected, Settings
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.scoring import score as compute
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.conditions import NO_HISTORY

BASE, RETRIEVAL, OWN = "perceptual-framesamp-modul", "retrieval-framesamp-modul", "my-memory"
FAMILIES = ("MoveCube", "InsertPeg")
EPISODES = 6
REVISION = "ab" * 32
SCHEMA = arrow_schema(Rollout)

ROOT = Path(__file__).parent.parent.parent
RELEASED = ROOT.parent / "shared" / "data" / "results" / "retrieval_rollouts.csv"
needs_released = pytest.mark.skipif(not RELEASED.exists(), reason="the released rows are not here")

# Outcomes of MoveCube 0-5, then InsertPeg 0-5: s success, f fail, t timeout, e error, - no row.
OUTCOMES = {
    (BASE, NO_HISTORY): "sfffffffffff",  # 1 of 12
    (BASE, "k0"): "sssssfssffff",  # 7 of 12
    (BASE, "k1"): "ssssffsfftff",  # 5 of 12
    (BASE, "k3"): "sssfffffffff",  # 3 of 12
    (BASE, "k7"): "ssffffffffff",  # 2 of 12
    (RETRIEVAL, "k0"): "sssssfsfsfff",  # 7 of 12
    (RETRIEVAL, "k7"): "sssssfssffft",  # 7 of 12
    (OWN, NO_HISTORY): "sfffffffffff",  # 1 of 12
    (OWN, "k0"): "sseff-ffffff",  # 2 of 10: an error and a missing row
}
GOOD = "my-memory,MoveCube,k0,0,7,easy,success,1,100"  # a line of the layout of `released`
STATUS = {"s": "success", "f": "fail", "t": "timeout", "e": "error"}


REPLAY, IDEAL = "replay-framesamp", "recall-framesamp"
KINDS = {  # of MoveCube 0 to 5
    (REPLAY, NO_HISTORY): "sfffff",
    (REPLAY, "k0"): "sssssf",
    (REPLAY, "k3"): "ssffff",
    (REPLAY, "before-k3"): "sffffs",
    (REPLAY, "held-k3"): "ssssff",
    (REPLAY, "held-k7"): "ssssff",
    (REPLAY, "absent-k3"): "ffffff",
    (REPLAY, "stale-k0"): "ssffff",
    (REPLAY, "misled-k0"): "ffffff",
    (IDEAL, "k0"): "ssssss",
    (IDEAL, "k3"): "ssssff",
}
KEPT = {  # thirds of the evidence
    (REPLAY, "k0"): (3, 3, 3, 3, 3, 3),
    (REPLAY, "k3"): (3, 3, 3, 1, 2, 0),
}

# Two questions of two options, then two of four. The right guesses are of the chances
# (1/2 + x/2)² (3/4 + x/4)² = (9 + 24 x + 22 x² + 8 x³ + x⁴) / 64.
CHANCES = (1 / 2, 1 / 2, 1 / 4, 1 / 4)
BLANK, RECALL = f"{OWN}-blank", "questions-recall-full"
ANSWERS = {
    (RECALL, "k0"): "ssss",
    (OWN, NO_HISTORY): "ssff",
    (OWN, "k0"): "sssf",
    (OWN, "k7"): "ssef",
    (BLANK, "k0"): "ffff",
}


def row(system: str, condition: str, family: str, episode: int, letter: str) -> Rollout:
    status = STATUS[letter]
    return Rollout(
        system=system,
        **to_dict(name_system(system).facts),
        simulator="tabletop",
        buffer_set="made-up",
        revision=REVISION,
        family=family,
        condition=condition,
        split="test",
        episode=episode,
        shift="none",
        model_seed=0,
        protocol_version=1,
        seed=1000 * FAMILIES.index(family) + episode,
        difficulty=("easy", "medium", "hard")[episode // 2 % 3],
        goal="do it",
        status=status,
        success=None if letter == "e" else letter == "s",
        steps=1300 if letter == "t" else 100,
        history_frames=0 if condition == NO_HISTORY else 100,
        lesson_frames=0 if condition == NO_HISTORY else 50,
        lesson_share=None if condition == NO_HISTORY else 0.5,
        error="it broke" if letter == "e" else None,
    )


def recording(condition: str, episode: int, values: tuple[float, ...] | None) -> Rollout:
    """A row of an offline run, with the errors of the values of an action; None if it broke."""
    one = row(OWN, condition, "MoveCube", episode, "s")
    one = replace(one, simulator="recordings", family="OpenDrawer", seed=None)
    if values is None:
        return replace(one, status="error", success=None, error="it broke")
    return replace(
        one,
        status="measured",
        success=None,
        action_l1=sum(values) / len(values),
        action_l1_values=" ".join(map(str, values)),
    )


def rows() -> list[Rollout]:
    """All rows of `OUTCOMES`."""
    return [
        row(system, condition, FAMILIES[place // EPISODES], place % EPISODES, letter)
        for (system, condition), letters in OUTCOMES.items()
        for place, letter in enumerate(letters)
        if letter != "-"
    ]


def cells(outcomes: Mapping[tuple[str, str], str], seed: int = 0) -> list[Rollout]:
    """Rows of MoveCube by system and condition: an episode a letter."""
    return [
        replace(row(system, condition, "MoveCube", place, letter), model_seed=seed)
        for (system, condition), letters in outcomes.items()
        for place, letter in enumerate(letters)
        if letter != "-"
    ]


def kinds(folder: Path, outcomes: Mapping[tuple[str, str], str] = KINDS) -> Score:
    """A score of several kinds of conditions, some with the evidence that was kept."""
    found = [
        replace(row, evidence_kept=KEPT[cell][row.episode] / 3)
        if (cell := (row.system, row.condition)) in KEPT
        else row
        for row in cells(outcomes)
    ]
    return score(write_parquet(folder / "kinds.parquet", found))


def questions(folder: Path) -> Score:
    """A score of answers; an error has no chance."""
    found = [
        replace(
            row,
            simulator="questions",
            steps=0,
            chance=None if row.status == "error" else CHANCES[row.episode],
        )
        for row in cells(ANSWERS)
    ]
    return score(write_parquet(folder / "questions.parquet", found))


def renamed(given: Iterable[Rollout], names: Mapping[str, str]) -> list[Rollout]:
    """The same rollouts with other labels."""
    return [replace(row, system=names[row.system]) for row in given]


def changed(given: Iterable[Rollout], **values: Any) -> list[Rollout]:
    """The same rollouts with other values."""
    return [replace(one, **values) for one in given]


def write_csv(path: Path, given: Sequence[Rollout]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(SCHEMA.names)
        for one in given:
            writer.writerow(["" if v is None else v for v in to_dict(one).values()])
    return path


def write_parquet(path: Path, given: Sequence[Rollout]) -> Path:
    pq.write_table(to_table(given, SCHEMA), path)
    return path


def write_run(
    folder: Path, given: Sequence[Rollout], identity: Mapping[str, Any] | None = None, **header: Any
) -> Path:
    """A run's folder, as far as scoring looks at it."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(to_dict(one)) + "\n" for one in given]
    (folder / "rollouts.jsonl").write_text("".join(lines), encoding="utf-8")
    run = RunHeader(1, dict(identity or {}), "made-up", **header)
    (folder / "run.json").write_text(json.dumps(to_dict(run)))
    return folder


def released(path: Path, lines: Sequence[str]) -> Path:
    """A file in the layout of the released rows, without what scoring does not need."""
    header = "system,family,condition,episode,seed,difficulty,status,success,steps"
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def score(
    *paths: Path,
    expected: Expected = Expected.OBSERVED,
    paper: bool = False,
    draws: int = 200,
    **options: Any,
) -> Score:
    """Score rows; by their own grid and with few draws, unless it is said otherwise."""
    if isinstance(system := options.get("system"), str):
        options["system"] = (system,)
    against = Against.PAPER if paper else None
    return compute(Settings(paths, expected=expected, against=against, **options), draws)


def records(found: Score, table: str, **equal: Any) -> list[dict[str, Any]]:
    """The rows of a table with given values."""
    return [
        record
        for record in found.tables[table].records()
        if all(record[name] == value for name, value in equal.items())
    ]


def record(found: Score, table: str, **equal: Any) -> dict[str, Any]:
    """The one row of a table with given values."""
    (one,) = records(found, table, **equal)
    return one


def run(*arguments: str | Path) -> Any:
    """What the command line does, in this process."""
    app = typer.Typer()
    app.command()(commands.score)
    app.command()(commands.compare)
    app.command()(commands.power)
    return CliRunner().invoke(app, list(map(str, arguments)))
