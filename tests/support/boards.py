"""A leaderboard over the tiny buffer set: published runs, and files that list them."""

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args, get_origin, get_type_hints

import pyarrow.parquet as pq
import yaml
from support import runs, scoring, worlds
from support.buffer_sets import GOLDEN

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.evaluate.leaderboard.entries import (
    Board,
    BoardStanding,
    MemoryKind,
    Reference,
    Submission,
    TrainedOn,
)
from robomme_interference_data.evaluate.leaderboard.published import CARD, RATES
from robomme_interference_data.evaluate.leaderboard.site import Leaderboard
from robomme_interference_data.evaluate.leaderboard.standings import (
    BoardRows,
    BoardSystem,
    Standings,
)
from robomme_interference_data.evaluate.run.row import Rollout, row_of
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.scoring import score as score_rows
from robomme_interference_data.schema.codec import arrow_schema, descriptions, to_table
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.text import canonical_json

BOARD, SYSTEM = "tiny", "my-memory"
SHA256 = "ab" * 32

Files = dict[str, bytes]
Change = Callable[[dict[str, Any]], dict[str, Any]]
"""From a row, or from `run.json`, to another one."""


def make_run(out: Path, policy: str, system: str, **changes: Any) -> Path:
    """Run a policy on every buffer of the tiny buffer set, with the leak probe."""
    all_of_it: dict[str, Any] = {"families": (), "conditions": (), "no_probe": False}
    runs.run(out, policy=policy, system=system, **all_of_it | changes)
    return out


def published(run: Path) -> Files:
    """Return the files of `publish-results` that rules read: without pictures, which are slow."""
    names = (RUN_HEADER, RUN_RECORD, *RUN_TABLES)
    files = {name: (run / name).read_bytes() for name in names}
    scored = score_rows(Settings(rows=(run,), expected=Expected.OBSERVED))
    return files | _stated(files, scored.tables["main"].csv().encode())


def _stated(files: Files, rates: bytes) -> Files:
    digest = hashlib.sha256(files[RUN_TABLES[0]]).hexdigest()
    return {CARD: f"| SHA-256 of `{RUN_TABLES[0]}` | `{digest}` |\n".encode(), RATES: rates}


def changed(
    files: Files, folder: Path, row: Change | None = None, header: Change | None = None
) -> Files:
    """Return files as if the run had had other rows or another header."""
    folder.mkdir(parents=True)
    content = json.loads(files[RUN_HEADER])
    lines = files[RUN_RECORD].decode().splitlines()
    rows = [json.loads(line) for line in lines]
    rows = [row(each) if row else each for each in rows]
    new = dict(files)
    new[RUN_HEADER] = json.dumps(header(content) if header else content).encode()
    new[RUN_RECORD] = "".join(f"{canonical_json(each)}\n" for each in rows if each).encode()
    table = to_table([row_of(line) for line in new[RUN_RECORD].splitlines()], arrow_schema(Rollout))
    pq.write_table(table, folder / RUN_TABLES[0])
    new[RUN_TABLES[0]] = (folder / RUN_TABLES[0]).read_bytes()
    for name in (RUN_HEADER, RUN_RECORD):
        (folder / name).write_bytes(new[name])
    rates = files[RATES]
    with suppress(ValueError):  # rows that no score takes
        rates = (
            score_rows(Settings((folder,), expected=Expected.OBSERVED))
            .tables["main"]
            .csv()
            .encode()
        )
    return new | _stated(new, rates)


def submission(*results: str, **changes: Any) -> dict[str, Any]:
    """Return a submission as it is written in the file."""
    names = ("checkpoint", "checkpoint_sha256")
    run = {"checkpoint": "someone/model@v1", "checkpoint_sha256": SHA256}
    run |= {name: changes.pop(name) for name in names if name in changes}
    entry: dict[str, Any] = {
        "system": SYSTEM,
        "board": BOARD,
        "memory": "frames",
        "trained_on": "nothing",
        "runs": [{"results": each, **run} for each in results],
    }
    return entry | changes


def write_board(path: Path, *submissions: dict[str, Any], **content: Any) -> Path:
    """Write a file with the board of the tiny buffer set and some submissions."""
    board = {"name": BOARD, "simulator": runs.WORLD, "buffer_set": str(GOLDEN)}
    whole = {"boards": [board], "references": [], **content, "submissions": [*submissions]}
    path.write_text(yaml.safe_dump(whole, sort_keys=False), encoding="utf-8")
    return path


def use_tiny(monkeypatch: Any) -> None:
    """Let worlds play the tiny buffer set."""
    monkeypatch.setenv(worlds.BUFFER_SET, str(GOLDEN))


def made_up(folder: Path) -> Leaderboard:
    """Return a board of made-up rows: two systems are ranked, beside a control and an example."""
    rows = [row for row in scoring.rows() if row.status != "error"]
    for place, family in enumerate(scoring.FAMILIES):
        for episode in range(scoring.EPISODES):
            letter = "f" if place or episode else "s"
            rows.append(scoring.row("guess", NO_HISTORY, family, episode, letter))
    path = scoring.write_parquet(folder / "rows.parquet", rows)
    standings = {
        scoring.BASE: BoardStanding.SUBMISSION,
        scoring.RETRIEVAL: BoardStanding.SUBMISSION,
        scoring.OWN: BoardStanding.EXAMPLE,
        "guess": BoardStanding.CONTROL,
    }
    shown = {name: BoardSystem(name, standing, None) for name, standing in standings.items()}
    board = Board(BOARD, "tabletop")
    return Leaderboard((Standings(board, None, [BoardRows((path,))], shown),), ())


SCHEMA = Path(__file__).parents[2] / "evaluate" / "leaderboard" / "results.schema.json"

_CHOICES = {
    "memory": MemoryKind,
    "trained_on": TrainedOn,
    "standing": ("control", "example", "unverified"),
}
_TYPES = {str: "string", int: "integer"}


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of the file of a leaderboard, for editors and other programs."""
    lists = {"boards": Board, "references": Reference, "submissions": Submission}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "The file of a leaderboard",
        "type": "object",
        "required": ["boards"],
        "additionalProperties": False,
        "properties": {
            name: {"type": ["array", "null"], "items": _object(record)}
            for name, record in lists.items()
        },
    }


def _object(record: type) -> dict[str, Any]:
    hints, texts = get_type_hints(record), descriptions(record)
    optional = {name for name, hint in hints.items() if isinstance(None, _class_of(hint))}
    return {
        "type": "object",
        "required": [name for name in hints if name not in optional],
        "additionalProperties": False,
        "properties": {
            name: _value(name, hint) | {"description": texts[name]} for name, hint in hints.items()
        },
    }


def _class_of(hint: Any) -> Any:
    """Return a hint as `isinstance` takes it."""
    return tuple if get_origin(hint) is tuple else hint


def _value(name: str, hint: Any) -> dict[str, Any]:
    if get_origin(hint) is tuple:
        item = get_args(hint)[0]
        items = {"type": "string"} if item is str else _object(item)
        return {"type": "array", "minItems": 1, "items": items}
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind is not type(None)]
    types = [_TYPES[kind] for kind in kinds] + ["null"] * (len(get_args(hint)) > 1)
    value: dict[str, Any] = {"type": types[0] if len(types) == 1 else types}
    if name in _CHOICES:
        value["enum"] = [*map(str, _CHOICES[name])] + [None] * (len(types) > 1)
    return value


GOLDEN_JSON = Path(__file__).parents[1] / "golden" / "leaderboard" / "leaderboard.json"


def make_golden_leaderboard(folder: Path) -> None:
    """Write the golden file of a site's data, and the schema of the file that it is made from."""
    write_json(SCHEMA, json_schema())
    with TemporaryDirectory() as name:
        made = made_up(Path(name))
        write_json(folder / GOLDEN_JSON.name, made.to_dict())
