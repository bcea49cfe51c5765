"""The checks of the twelve rules: each yields what does not hold, a sentence each."""

import csv
import hashlib
import re
from collections import Counter
from collections.abc import Iterator

from robomme_interference_data.constants import PROTOCOL_VERSION, QUESTIONS, RUN_TABLES
from robomme_interference_data.errors import InterferenceError, counted, first_line
from robomme_interference_data.evaluate.probe.noise import LEAK_P
from robomme_interference_data.evaluate.probe.result import BROKEN, probe_text
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.scoring import score
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.schema.codec import arrow_schema, to_table
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.rollouts import KEY_COLUMNS, Status
from robomme_interference_data.schema.shifts import NO_SHIFT
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.parquet import open_parquet, read_table
from robomme_interference_data.storage.text import read_text

from .entries import MemoryKind
from .published import CARD, RATES, Case, Results

MAX_ERRORS = 0.01
"""Largest share of the rollouts under a condition that broke."""

_DRAWS = 100
"""Bootstrap samples: rates do not depend on them."""

_SHOWN = 3


# --- 1 to 5: the rows --------------------------------------------------------------------------


def protocol(case: Case) -> Iterator[str]:
    """Yield rows of another version of the protocol."""
    found = Counter(row.protocol_version for row in case.rows)
    for version, count in sorted(found.items()):
        if version != PROTOCOL_VERSION:
            yield f"{counted(count, 'row')} of version {version}; expected {PROTOCOL_VERSION}"


def buffer_set(case: Case) -> Iterator[str]:
    """Yield rows of another buffer set, simulator or scene."""
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


def complete_cells(case: Case) -> Iterator[str]:
    """Yield cells that lack episodes."""
    if case.grid is None:
        return
    ran = {(row.condition, _repeat(row), row.episode_id) for row in case.rows}
    repeats = sorted({_repeat(row) for row in case.rows}, key=str)
    facts = case.rows[0] if case.rows else None
    conditions = {row.condition for row in case.rows}
    for condition in case.grid.conditions:
        applies = facts is None or facts.applies(condition)
        # Who has rows with a history has them under all conditions, whatever the rows state.
        applies |= condition != NO_HISTORY and bool(conditions - {NO_HISTORY})
        if not applies and condition not in conditions:
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


def duplicates(case: Case) -> Iterator[str]:
    """Yield rollouts with several rows."""
    twice = [key for key, count in Counter(row.key for row in case.rows).items() if count > 1]
    for key in twice[:_SHOWN]:
        values = dict(zip(KEY_COLUMNS, key, strict=True))
        yield (
            f"{values['family']}/{values['split']}/{values['episode']} under "
            f"{values['condition']} has several rows"
        )
    if len(twice) > _SHOWN:
        yield f"and {len(twice) - _SHOWN} more"


def few_errors(case: Case) -> Iterator[str]:
    """Yield conditions under which too many rollouts broke.

    Broken rollouts count in no rate, so a pooled share would let many be left out of one rate.
    """
    broken: dict[str, list[Rollout]] = {}
    for row in case.rows:
        if row.status == Status.ERROR:
            broken.setdefault(row.condition, []).append(row)
    counts = Counter(row.condition for row in case.rows)
    for condition, rows in broken.items():
        if len(rows) > MAX_ERRORS * counts[condition]:
            yield (
                f"{len(rows)} of {counted(counts[condition], 'rollout')} under {condition} broke, "
                f"such as {rows[0].episode_id}: {rows[0].error}; expected at most {MAX_ERRORS:.0%}"
            )


# --- 6 to 8: the runs ----------------------------------------------------------------------------


def probed(case: Case) -> Iterator[str]:
    """Yield runs that were not probed."""
    if case.board.simulator == QUESTIONS:  # each is asked by itself
        return
    for results in case.results:
        probe = results.header.probe
        if probe is None:
            yield f"{results.run.results} was not probed"
        elif probe.unprobed:
            yield f"{results.run.results}: not probed: {', '.join(probe.unprobed)}"


def independent(case: Case) -> Iterator[str]:
    """Yield runs whose probe broke or found a leak."""
    for results in case.results:
        probe = results.header.probe
        if probe is None:
            continue
        # A leak that is found leaves no run, but a header can be edited.
        leaks = probe.p_value is not None and probe.p_value < LEAK_P
        if probe.verdict == BROKEN or leaks:
            yield f"{results.run.results}: {probe_text(probe)}"


def histories(case: Case) -> Iterator[str]:
    """Yield histories that are not those of the buffer set."""
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


def repository(case: Case) -> Iterator[str]:
    """Yield repositories that cannot be read, and folders where the board is on the Hub."""
    public = case.grid is not None and isinstance(case.grid.buffer_set.files, HubFiles)
    for results in case.results:
        if results.fault:
            yield f"{results.run.results}: {results.fault}"
        elif public and not results.on_hub:
            yield f"{results.run.results} is a folder, and the board's buffer set is on the Hub"


def checkpoint(case: Case) -> Iterator[str]:
    """Yield checkpoints that are not named, or without a hash."""
    for results in case.results:
        run = results.run
        if not run.checkpoint.strip():
            yield f"{run.results}: checkpoint is empty; expected where the weights are"
        if not re.fullmatch(r"[0-9a-f]{64}", run.checkpoint_sha256):
            yield (
                f"{run.results}: checkpoint_sha256 {run.checkpoint_sha256!r}; expected 64 "
                "hexadecimal digits"
            )
        elif run.checkpoint_sha256 == hashlib.sha256().hexdigest():
            yield f"{run.results}: checkpoint_sha256 is that of an empty file"


def unchanged(case: Case) -> Iterator[str]:
    """Yield rows that are not those of the card, or do not give the stated rates."""
    for results in case.results:
        for what in _changes(results):
            yield f"{results.run.results}: {what}"


def _changes(results: Results) -> Iterator[str]:
    path = results.folder / RUN_TABLES[0]
    try:
        card = read_text(results.folder / CARD)
        rates = read_text(results.folder / RATES)
        with open_parquet(path) as opened:
            table = read_table(opened, path).to_pylist()
    except InterferenceError as error:
        yield first_line(error)
        return
    stated = re.search(rf"SHA-256 of `{re.escape(path.name)}`.*?\b([0-9a-f]{{64}})\b", card)
    if stated is None:
        yield f"{CARD} does not state the SHA-256 of {path.name}"
    elif stated[1] != sha256_file(path):
        yield f"the SHA-256 of {path.name} is not the one that {CARD} states"
    recorded = to_table(results.rows, arrow_schema(Rollout)).to_pylist()
    if sorted(map(repr, recorded)) != sorted(map(repr, table)):
        yield f"{path.name} does not hold the rows of the record"
    yield from _other_rates(results, rates)


def _other_rates(results: Results, stated: str) -> Iterator[str]:
    """Yield rates in which the repository, as CSV, and its rows differ."""
    settings = Settings(rows=(results.folder,), expected=Expected.OBSERVED)
    try:
        scored = score(settings, _DRAWS)
    except InterferenceError as error:
        yield f"the rows cannot be scored: {error.message}"
        return
    names = ("simulator", "system", "condition", "n", "successes", "rate")
    try:
        ours, theirs = (
            {tuple(map(row.get, names)) for row in csv.DictReader(text.splitlines())}
            for text in (scored.tables["main"].csv(), stated)
        )
    except csv.Error as error:
        yield f"{RATES} cannot be read: {error}"
        return
    differing = {cell[1:3] for cell in ours ^ theirs if cell[3] != "0"}
    for system, condition in sorted(differing, key=str)[:_SHOWN]:
        yield f"{RATES} has another rate of {system} under {condition} than its rows"


def stated_system(case: Case) -> Iterator[str]:
    """Yield names that are taken, and facts that contradict the rows."""
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
