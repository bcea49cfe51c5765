"""The film strip of a card: which buffer is shown, and its picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.viz.filmstrip import shown_camera, strip_png

STRIP = "README-strip.png"

_FIRST_CHOICE = "k3"
"""The condition that a strip shows if there is such a one."""


@dataclass(frozen=True)
class Film:
    """A buffer and its film strip, which is drawn once, when it is first needed."""

    buffer: Buffer

    @cached_property
    def _png(self) -> bytes:
        self.buffer.fetch([self.camera])
        return strip_png(self.buffer)

    def pictures(self) -> dict[str, bytes]:
        """Return the picture by its path."""
        return {STRIP: self._png}

    @property
    def camera(self) -> str:
        """The camera that is shown."""
        return shown_camera(self.buffer)

    @property
    def about(self) -> str:
        """What it shows, in a sentence."""
        buffer = self.buffer
        sessions = ", ".join(f"{one.role} {one.source}" for one in buffer.sessions) or "no session"
        return f"{buffer.episode_id} under {buffer.condition}: {sessions}. Goal: {buffer.goal}"


def film_of_buffer_set(
    buffer_set: BufferSet, queries: Sequence[EpisodeRecord], manifests: Sequence[BufferManifest]
) -> Film:
    """Return the film strip of the first query, under `k3` or what holds most sessions."""
    if not (manifests and queries):
        raise FormatError.damaged(buffer_set.location, "no buffers")
    first = queries[0].episode_id
    own = [one for one in manifests if one.episode_id == first]
    chosen = max(own, key=lambda one: (one.condition == _FIRST_CHOICE, len(one.sessions)))
    # Of a buffer set on the Hub no video is fetched before it is drawn.
    return Film(buffer_set.load(first, chosen.condition, cameras=()))


def film_of_lesson(dataset: Dataset, records: Sequence[EpisodeRecord]) -> Film:
    """Return the film strip of the first lesson: a buffer of nothing else."""
    if not records:
        raise FormatError.damaged(dataset.files.describe(), "no episodes")
    query, lesson = Query(dataset, records[0]), dataset.session("lesson", records[0])
    manifest = query.manifest(parse_condition("k0"), (lesson,), exact=records[0].exact)
    return Film(Buffer(manifest, query, {dataset.kind: dataset}))
