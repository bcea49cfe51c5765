"""Choose the sessions of history buffers from datasets (rules 1 to 5 of the protocol).

The draw of distractor units is in `schema/draw.py`.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DAYS,
    DEMONSTRATIONS,
    DISTRACTORS,
    RAW_DISTRACTORS,
)
from robomme_interference_data.errors import BuildError, FormatError, HashMismatchError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import Condition, parse_condition
from robomme_interference_data.schema.draw import (
    UnitPool,
    check_units,
    only_in_days,
    too_few_follow,
)
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry, layout_sessions
from robomme_interference_data.schema.records import Day, DayQuery, DaySpan, EpisodeRecord
from robomme_interference_data.schema.sampling import lesson_frames, lesson_share
from robomme_interference_data.storage.files import LocalFiles

from .dataset import Dataset
from .query import Query

_ROLES = {
    DEMONSTRATIONS: "lesson",
    DISTRACTORS: "distractor",
    RAW_DISTRACTORS: "distractor",
    CONTRADICTIONS: "contradiction",
}
"""Role of a session by its dataset."""


@dataclass(frozen=True)
class SessionSource:
    """The datasets of a buffer set by name, and the seed of the draw.

    `unit_episodes` are the indices of the episodes whose units may be drawn; None for all.
    """

    datasets: Mapping[str, Dataset]
    seed: int = 0
    unit_episodes: Collection[int] | None = None

    def planned(self, episode: EpisodeId, condition: Condition) -> BufferManifest:
        """Return the manifest that the rules give for a query episode under a condition."""
        if episode not in self._queries:
            demonstrations = self.datasets[DEMONSTRATIONS]
            record = demonstrations.record(demonstrations.index_of(episode))
            self._queries[episode] = QuerySessions(self, record)
        return self._queries[episode].buffer(condition)

    def check(self, manifest: BufferManifest) -> None:
        """Check that a manifest is the one that the rules give.

        Raises:
            HashMismatchError: It is not.
            SourceError, BuildError: The datasets lack what its condition needs.
        """
        planned = self.planned(manifest.episode_id, parse_condition(manifest.condition))
        # Field by field, so that the error names what differs.
        for name, value in vars(planned).items():
            if getattr(manifest, name) != value:
                raise HashMismatchError.damaged(
                    f"{name} of {manifest} is not what the rules give for its query, the units "
                    "and the seed"
                )

    @cached_property
    def pool(self) -> UnitPool:
        """The units to draw from."""
        allowed = self.unit_episodes
        units = (record.episode_id for record in self.datasets[DISTRACTORS].records())
        return UnitPool((u for u in units if allowed is None or u.index in allowed), self.seed)

    def session(self, name: str, episode: EpisodeId) -> SessionEntry:
        """Return the session of an episode in a dataset; contradictions go by their query's id."""
        dataset = self.datasets[name]
        if name not in self._sessions:
            sessions = self._sessions[name] = {}
            for record in dataset.records():
                key = record.episode_id
                if name == CONTRADICTIONS:  # its own id has another answer than its query's
                    key = key.scene
                sessions[key] = dataset.session(_ROLES[name], record)
        session = self._sessions[name].get(episode)
        if session is None:
            raise SourceError(
                f"{dataset.files.describe()} lacks {episode}, which a buffer needs",
                "Build it from the same episodes.",
                f"build BUFFER_SET --only {name} --source KIND:PATH",
            )
        return session

    def longest(self, name: str) -> SessionEntry:
        """Return the longest session of the units in a dataset that may be drawn."""
        allowed = self.unit_episodes
        units = [record.episode_id for record in self.datasets[name].records()]
        sessions = [
            self.session(name, unit) for unit in units if allowed is None or unit.index in allowed
        ]
        return max(sessions, key=lambda session: session.num_frames)

    def day_of(self, episode: EpisodeId) -> tuple[EpisodeRecord, Day, DayQuery]:
        """Return the day that holds a query episode, and where in it."""
        if episode not in self._days:
            raise SourceError(
                f"{episode} is a query of none of the days in "
                f"{self.datasets[DAYS].files.describe()}",
                "Build the days and the demonstrations of the same numbers.",
                f"build BUFFER_SET --only {DAYS} --source KIND",
            )
        return self._days[episode]

    @cached_property
    def _days(self) -> dict[EpisodeId, tuple[EpisodeRecord, Day, DayQuery]]:
        found: dict[EpisodeId, tuple[EpisodeRecord, Day, DayQuery]] = {}
        for record in self.datasets[DAYS].records():
            if record.day is None:
                where = self.datasets[DAYS].files.describe()
                raise FormatError.damaged(where, f"{record.episode_id}: no tasks")
            for query in record.day.queries:
                if query.episode in found:
                    days = f"{found[query.episode][0].episode_id} and {record.episode_id}"
                    raise SourceError(
                        f"{query.episode} is a query of two days, {days}",
                        "Build days of different lengths into separate buffer sets.",
                    )
                found[query.episode] = record, record.day, query
        return found

    @cached_property
    def _queries(self) -> "dict[EpisodeId, QuerySessions]":
        return {}

    @cached_property
    def _sessions(self) -> dict[str, dict[EpisodeId, SessionEntry]]:
        return {}


class QuerySessions:
    """The sessions that conditions can use for one query; see `conditions.SessionProvider`."""

    def __init__(self, source: SessionSource, record: EpisodeRecord):
        self._source = source
        self._record = record
        self._drawn: dict[bool, list[EpisodeId]] = {False: [], True: []}

    def buffer(self, condition: Condition) -> BufferManifest:
        """Return the manifest of the query's buffer under a condition."""
        datasets, record = self._source.datasets, self._record
        sessions = condition.sessions(self)
        exact = record.exact and all(
            datasets[entry.dataset].record(entry.episode_index).exact for entry in sessions
        )
        query = Query(datasets[DEMONSTRATIONS], record)
        return buffer_manifest(query, condition, sessions, exact=exact)

    def lesson(self, part: str = "lesson") -> SessionEntry:
        """Return the lesson, or a part of it."""
        record = self._record
        if record.ability == "absent":
            raise only_in_days(record.episode_id)
        whole = self._source.session(DEMONSTRATIONS, record.episode_id)
        if part == "lesson":
            return whole
        if part not in record.spans or record.span_sha256 is None:
            where = self._source.datasets[DEMONSTRATIONS].files.describe()
            raise FormatError.damaged(where, f"{record.episode_id}: no digests of its parts")
        start, stop = record.spans[part]
        sha256 = getattr(record.span_sha256, part)
        session = replace(whole, start=start, stop=stop, sha256=sha256)
        if part != "last":
            return session
        return replace(
            session, role="filler", repeat=self._source.datasets[DISTRACTORS].unit.frames
        )

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        """Return the units drawn for the query, or the raw units of the same episodes."""
        return [self._source.session(dataset, unit) for unit in self._draw(k, same_family=False)]

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        """Return the units of the query's own family drawn for it."""
        return [self._source.session(DISTRACTORS, unit) for unit in self._draw(k, same_family=True)]

    def contradiction(self) -> SessionEntry:
        """Return the lesson in the query's scene with another answer."""
        if self._record.ability is not None:
            raise only_in_days(self._record.episode_id)
        return self._source.session(CONTRADICTIONS, self._record.episode_id)

    def day(self, k: int) -> Sequence[SessionEntry]:
        """Return the sessions of the query's day up to `k` tasks after its last lesson.

        Raises:
            BuildError: So many tasks do not follow.
        """
        query = self._record.episode_id
        record, day, asked = self._source.day_of(query)
        tasks = [span for span in day.spans if span.part != "transition"]
        further = len(tasks) - 1 - asked.task
        if k > further:
            raise too_few_follow(query, record.episode_id, further, k)
        stop = tasks[asked.task + k].stop
        dataset = self._source.datasets[DAYS]
        return [
            SessionEntry(
                _role_in_day(span, query),
                span.source.family,
                span.source,
                dataset.kind,
                dataset.revision,
                record.episode_index,
                span.start,
                span.stop,
                1,
                span.sha256,
            )
            for span in day.spans
            if span.stop <= stop
        ]

    def _draw(self, k: int, *, same_family: bool) -> Sequence[EpisodeId]:
        if k > len(self._drawn[same_family]):  # a shorter draw is the beginning of a longer one
            draw = self._source.pool.draw_own if same_family else self._source.pool.draw
            self._drawn[same_family] = draw(self._record.episode_id, k)
        return self._drawn[same_family][:k]


def _role_in_day(span: DaySpan, query: EpisodeId) -> str:
    """Return the role that a span of a day has for one of its queries; one of `ROLES`."""
    if span.part == "transition":
        return "transition"
    if span.part == "idle":
        return "filler"
    if span.source == query:
        return "lesson"
    return "contradiction" if span.source.scene == query else "distractor"


def buffer_manifest(
    query: Query, condition: Condition, sessions: tuple[SessionEntry, ...], *, exact: bool
) -> BufferManifest:
    """Return the manifest of a query's buffer.

    Args:
        query: The query.
        condition: The condition.
        sessions: The buffer's sessions in order.
        exact: Whether all frames equal the recorded ones bit for bit.
    """
    record, lessons = query.record, layout_sessions(sessions, "lesson")
    frames = sum(entry.num_frames for entry in sessions)
    return BufferManifest(
        episode_id=record.episode_id,
        condition=condition.name,
        k=condition.k,
        goals=record.goals,
        seed=record.seed,
        difficulty=record.difficulty,
        simulator=record.simulator,
        exact=exact,
        lesson_frames=lesson_frames(lessons, range(frames)),
        history_frames=frames,
        lesson_share=lesson_share(lessons, range(frames)),
        query=query.first_frame,
        sessions=sessions,
    )


def lacking_for(condition: Condition, root: Path, queries: Iterable[Query]) -> str | None:
    """Return what the folder of a buffer set lacks for buffers under a condition; None if nothing.

    Args:
        condition: The condition.
        root: The folder.
        queries: The queries.
    """
    names = [name for name in condition.kind.needs if not (root / name).is_dir()]
    if names:
        return f"For {condition}, build the {' and '.join(names)} first."
    # Without the check of its revision: the next plan draws from the units that are there now.
    units = Dataset(LocalFiles(root / DISTRACTORS)).records()
    abilities = {query.episode_id: query.record.ability for query in queries}
    absent = {episode for episode, ability in abilities.items() if ability == "absent"}
    try:
        pool = UnitPool(unit.episode_id for unit in units)
        check_units(pool, abilities, [condition], absent)
    except BuildError as error:
        return f"For {condition}, {error.message}."
    return None
