"""The twelve rules of a submission: what each checks, and what to do where it does not hold.

Rules 9, 10 and 12 need the entry alone; the others read the rows, and are left out if the rows
cannot be read. No rule stops another one, so that a submission learns of all problems at once.
"""

import csv
import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pyarrow.parquet as pq

from robomme_interference_data.constants import PROTOCOL_VERSION, QUESTIONS, RUN_TABLES
from robomme_interference_data.errors import InterferenceError, counted
from robomme_interference_data.evaluate.probe.noise import LEAK_P
from robomme_interference_data.evaluate.probe.result import BROKEN, probe_text
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.scoring import score
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.schema.codec import arrow_schema, to_table
from robomme_interference_data.schema.rollouts import KEY_COLUMNS, Status
from robomme_interference_data.schema.shifts import NO_SHIFT

from .entries import MemoryKind
from .published import CARD, RATES, Case, Results

MAX_ERRORS = 0.01
"""Largest share of rollouts that broke."""

_DRAWS = 100
"""Bootstrap samples: rates do not depend on them."""

_SHOWN = 3


@dataclass(frozen=True)
class Rule:
    """A rule.

    Attributes:
        number: Its number, from 1.
        name: What it is about, in a few words.
        fix: What to do where it does not hold.
        problems: Yields what does not hold, a sentence each.
        reads_rows: Whether it needs the rows.
    """

    number: int
    name: str
    fix: str
    problems: Callable[[Case], Iterator[str]]
    reads_rows: bool = True


@dataclass(frozen=True)
class Problem:
    """Why a submission is not accepted."""

    system: str
    rule: Rule
    what: str

    def __str__(self) -> str:
        return f"{self.system}: rule {self.rule.number}, {self.rule.name}: {self.what}"


def check(case: Case) -> list[Problem]:
    """Return everything that does not hold of a submission."""
    return [
        Problem(case.submission.system, rule, what)
        for rule in RULES
        if case.readable or not rule.reads_rows
        for what in rule.problems(case)
    ]


# --- 1 to 5: the rows --------------------------------------------------------------------------


def _protocol(case: Case) -> Iterator[str]:
    found = Counter(row.protocol_version for row in case.rows)
    for version, count in sorted(found.items()):
        if version != PROTOCOL_VERSION:
            yield f"{counted(count, 'row')} of version {version}; expected {PROTOCOL_VERSION}"


def _buffer_set(case: Case) -> Iterator[str]:
    if case.grid is None:
        yield f"the board {case.board.name} has no buffer set, and so takes no submissions"
        return
    for revision, count in Counter(row.revision for row in case.rows).items():
        if revision != case.grid.revision:
            yield (
                f"{counted(count, 'row')} of the revision {revision[:16]}…; expected "
                f"{case.grid.revision[:16]}…"
            )
    for simulator, count in Counter(row.simulator for row in case.rows).items():
        if simulator != case.board.simulator:
            yield (
                f"{counted(count, 'row')} of the simulator {simulator}; expected "
                f"{case.board.simulator}"
            )
    if shifts := sorted({row.shift for row in case.rows} - {NO_SHIFT}):
        yield f"rows under the shift {', '.join(shifts)}; expected none"


def _cells(case: Case) -> Iterator[str]:
    if case.grid is None:
        return
    ran = {(row.condition, _repeat(row), row.episode_id) for row in case.rows}
    repeats = sorted({_repeat(row) for row in case.rows}, key=str)
    facts = case.rows[0] if case.rows else None
    for condition in case.grid.conditions:
        if facts is not None and not facts.applies(condition):
            continue
        episodes = case.grid.episodes(condition)
        for repeat in repeats:
            missing = [each for each in episodes if (condition, repeat, each) not in ran]
            if missing:
                training_seed, model_seed = repeat
                yield (
                    f"{condition}, training seed {training_seed}, model seed {model_seed}: "
                    f"{len(missing)} of {counted(len(episodes), 'episode')} without a row, such as "
                    f"{missing[0]}"
                )
    if not case.rows:
        yield "there are no rows"


def _repeat(row: Rollout) -> tuple[int | None, int]:
    return row.training_seed, row.model_seed


def _duplicates(case: Case) -> Iterator[str]:
    twice = [key for key, count in Counter(row.key for row in case.rows).items() if count > 1]
    for key in twice[:_SHOWN]:
        values = dict(zip(KEY_COLUMNS, key, strict=True))
        yield (
            f"{values['family']}/{values['split']}/{values['episode']} under "
            f"{values['condition']} has several rows"
        )
    if len(twice) > _SHOWN:
        yield f"and {len(twice) - _SHOWN} more"


def _errors(case: Case) -> Iterator[str]:
    broken = [row for row in case.rows if row.status == Status.ERROR]
    if len(broken) > MAX_ERRORS * len(case.rows):
        yield (
            f"{len(broken)} of {counted(len(case.rows), 'rollout')} broke, such as "
            f"{broken[0].episode_id} under {broken[0].condition}: {broken[0].error}; expected at "
            f"most {MAX_ERRORS:.0%}"
        )


# --- 6 to 8: the runs ----------------------------------------------------------------------------


def _probed(case: Case) -> Iterator[str]:
    if case.board.simulator == QUESTIONS:  # each is asked by itself
        return
    for results in case.results:
        probe = results.header.probe
        if probe is None:
            yield f"{results.run.results} was not probed"
        elif probe.unprobed:
            yield f"{results.run.results}: not probed: {', '.join(probe.unprobed)}"


def _independent(case: Case) -> Iterator[str]:
    for results in case.results:
        probe = results.header.probe
        if probe is None:
            continue
        # A leak that is found leaves no run, but a header can be edited.
        leaks = probe.p_value is not None and probe.p_value < LEAK_P
        if probe.verdict == BROKEN or leaks:
            yield f"{results.run.results}: {probe_text(probe)}"


def _histories(case: Case) -> Iterator[str]:
    if case.grid is None:
        return
    wrong = [text for row in case.rows if (text := _other_history(case, row))]
    yield from wrong[:_SHOWN]
    if len(wrong) > _SHOWN:
        yield f"and {counted(len(wrong) - _SHOWN, 'row')} more"


def _other_history(case: Case, row: Rollout) -> str:
    """Return how the history of a row differs from the buffer set's; empty if it does not."""
    assert case.grid is not None
    where = f"{row.episode_id} under {row.condition}"
    manifest = case.grid.manifests.get((row.episode_id, row.condition))
    if manifest is None:
        return f"{where}: the buffer set has no such buffer"
    if row.status == Status.ERROR:  # it may have broken before its history came
        return ""
    for name in ("seed", "difficulty"):
        if getattr(row, name) != getattr(manifest, name):
            return f"{where}: {name} {getattr(row, name)}; expected {getattr(manifest, name)}"
    for name in ("history_frames", "lesson_frames"):
        given, expected = getattr(row, name), getattr(manifest, name)
        # A retrieval step chooses some of the frames.
        if given > expected or (given < expected and row.retrieval is None and row.reads_history):
            return f"{where}: {name} {given}; expected {expected}"
    return ""


# --- 9 to 12: what the entry names -------------------------------------------------------------


def _repository(case: Case) -> Iterator[str]:
    for results in case.results:
        if results.fault:
            yield f"{results.run.results}: {results.fault}"


def _checkpoint(case: Case) -> Iterator[str]:
    for results in case.results:
        run = results.run
        if not run.checkpoint.strip():
            yield f"{run.results}: checkpoint is empty; expected where the weights are"
        if not re.fullmatch(r"[0-9a-f]{64}", run.checkpoint_sha256):
            yield (
                f"{run.results}: checkpoint_sha256 {run.checkpoint_sha256!r}; expected 64 "
                "hexadecimal digits"
            )


def _unchanged(case: Case) -> Iterator[str]:
    for results in case.results:
        for what in _changes(results):
            yield f"{results.run.results}: {what}"


def _changes(results: Results) -> Iterator[str]:
    path = results.folder / RUN_TABLES[0]
    data = path.read_bytes()
    stated = re.search(
        rf"SHA-256 of `{re.escape(path.name)}`.*?\b([0-9a-f]{{64}})\b",
        (results.folder / CARD).read_text(encoding="utf-8", errors="replace"),
    )
    if stated is None:
        yield f"{CARD} does not state the SHA-256 of {path.name}"
    elif stated[1] != hashlib.sha256(data).hexdigest():
        yield f"the SHA-256 of {path.name} is not the one that {CARD} states"
    try:
        recorded = to_table(results.rows, arrow_schema(Rollout)).to_pylist()
        table = pq.read_table(path).to_pylist()
    except (OSError, ValueError) as error:
        yield f"{path.name} cannot be read: {str(error).partition(chr(10))[0]}"
        return
    if sorted(map(repr, recorded)) != sorted(map(repr, table)):
        yield f"{path.name} does not hold the rows of the record"
    yield from _other_rates(results)


def _other_rates(results: Results) -> Iterator[str]:
    """Yield rates that the repository states and its rows do not give."""
    settings = Settings(rows=(results.folder,), expected=Expected.OBSERVED)
    try:
        scored = score(settings, _DRAWS)
    except InterferenceError as error:
        yield f"the rows cannot be scored: {error.message}"
        return
    names = ("simulator", "system", "condition", "n", "successes", "rate")
    ours, theirs = (
        {tuple(row[name] for name in names) for row in csv.DictReader(text.splitlines())}
        for text in (
            scored.tables["main"].csv(),
            (results.folder / RATES).read_text(encoding="utf-8", errors="replace"),
        )
    )
    for cell in sorted(cell for cell in ours - theirs if cell[3] != "0")[:_SHOWN]:
        _, system, condition, n, _, rate = cell
        yield (
            f"{RATES} has another rate of {system} under {condition} than its rows: {rate} over "
            f"{n} episodes"
        )


def _system(case: Case) -> Iterator[str]:
    submission = case.submission
    if submission.system in case.taken:
        yield f"{submission.system} is on the board {case.board.name} already"
    elif submission.system in SYSTEMS:
        yield f"{submission.system} is the name of a known system"
    if not case.readable:
        return
    if others := sorted({row.system for row in case.rows} - {submission.system}):
        yield f"rows of {', '.join(others)}"
    facts = {(row.reads_history, row.memory is not None) for row in case.rows}
    reads, keeps = (any(values) for values in zip(*facts, strict=True)) if facts else (False, False)
    if reads and submission.memory == MemoryKind.NONE:
        yield "memory none, but its rows state that it reads the history"
    if not reads and submission.memory != MemoryKind.NONE:
        yield f"memory {submission.memory}, but its rows state that it reads no history"
    if reads and not keeps and submission.memory == MemoryKind.FRAMES:
        yield "memory frames, but its rows state no rule by which it keeps frames"
    if any(row.reference for row in case.rows) or any(
        invocation.policy.get("privileged")
        for results in case.results
        for invocation in results.header.invocations
    ):
        yield "its policy knows the answer, or is a control: those are references, never ranked"


RULES = (
    Rule(
        1,
        "protocol version",
        "Run it again with this version of the package: see docs/how-to/your-own-policy.md.",
        _protocol,
    ),
    Rule(
        2,
        "buffer set",
        "Run it on the board's buffer set, in its simulator and without a shift.",
        _buffer_set,
    ),
    Rule(
        3,
        "complete cells",
        "Run the same evaluate command again without --conditions, --families and --episodes.",
        _cells,
    ),
    Rule(
        4, "one row for a rollout", "Leave out one of the runs, or merge their shards.", _duplicates
    ),
    Rule(5, "few errors", "Run the same evaluate command again: it repeats what broke.", _errors),
    Rule(6, "probed for leaks", "Run it without --no-probe in a new folder.", _probed),
    Rule(
        7,
        "no state survives a reset",
        "Let the policy forget everything at a reset, and run it in a new folder.",
        _independent,
    ),
    Rule(
        8,
        "histories of the buffer set",
        "Evaluate on the buffer set as it was published: see verify.",
        _histories,
    ),
    Rule(
        9,
        "repository and commit",
        "Publish the run with publish-results, and name namespace/name@COMMIT, all 40 digits.",
        _repository,
        reads_rows=False,
    ),
    Rule(
        10,
        "checkpoint",
        "Name the weights, and their SHA-256: sha256sum FILE.",
        _checkpoint,
        reads_rows=False,
    ),
    Rule(11, "rows as published", "Publish the run again, with a higher --version.", _unchanged),
    Rule(
        12,
        "one system, as stated",
        "Choose a name of your own (--system of evaluate), and state what its rows state.",
        _system,
        reads_rows=False,
    ),
)
"""All rules, in order."""
