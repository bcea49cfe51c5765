"""The film strip of a card: which buffer is shown, and its picture."""

from dataclasses import dataclass
from functools import cached_property

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.viz.filmstrip import shown_camera, strip_png

from .facts import DatasetFacts, SplitFacts

FIRST_CHOICE = "k3"
"""The condition that a strip shows if there is such a one."""


@dataclass(frozen=True)
class Film:
    """A buffer and its film strip.

    Attributes:
        buffer: The buffer.
    """

    buffer: Buffer

    @cached_property
    def png(self) -> bytes:
        """The picture; drawn only when it is asked for.

        Raises:
            MissingExtraError: matplotlib is not installed.
            MissingFileError, FormatError: A video cannot be read.
        """
        self.buffer.fetch([self.camera])
        return strip_png(self.buffer)

    @property
    def camera(self) -> str:
        """The camera that is shown."""
        return shown_camera(self.buffer)

    @property
    def condition(self) -> str:
        """Its condition."""
        return self.buffer.condition

    @property
    def about(self) -> str:
        """What it shows, in a sentence."""
        buffer = self.buffer
        sessions = ", ".join(f"{one.role} {one.source}" for one in buffer.sessions) or "no session"
        return f"{buffer.episode_id} under {buffer.condition}: {sessions}. Goal: {buffer.goal}"


def film_of_split(facts: SplitFacts) -> Film:
    """Return the film strip of the first query, under `k3` or whatever holds most sessions.

    Raises:
        FormatError: The split holds no buffer.
    """
    split = facts.split
    if not (facts.manifests and facts.queries):
        raise FormatError.damaged(split.location, "no buffers")
    first = facts.queries[0].episode_id
    own = [one for one in facts.manifests if one.episode_id == first]
    chosen = max(own, key=lambda one: (one.condition == FIRST_CHOICE, len(one.sessions)))
    # Of a split on the Hub no video is fetched before it is drawn.
    return Film(split.load(first, chosen.condition, cameras=()))


def film_of_lesson(facts: DatasetFacts) -> Film:
    """Return the film strip of the first lesson: a buffer of nothing else.

    Raises:
        FormatError: The dataset holds no lesson.
    """
    dataset = facts.dataset
    if not facts.records:
        raise FormatError.damaged(dataset.files.describe(), "no episodes")
    record = facts.records[0]
    query, lesson = Query(dataset, record), dataset.session("lesson", record)
    manifest = query.manifest(parse_condition("k0"), (lesson,), exact=record.exact)
    return Film(Buffer(manifest, query, {dataset.kind: dataset}))
