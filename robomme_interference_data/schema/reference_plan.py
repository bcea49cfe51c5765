"""Records of a reference plan: which sessions each query gets, before anyone publishes frames."""

from dataclasses import dataclass
from typing import Annotated

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId


@dataclass(frozen=True)
class ReferenceSession:
    """A session of a buffer; `episodes` has the number of its frames."""

    role: Annotated[str, "Its role in the buffer, such as `lesson` or `distractor`."]
    dataset: Annotated[str, "Name of the dataset in the buffer set, such as `demonstrations`."]
    source: Annotated[EpisodeId, "Id of the recorded episode."]

    def __str__(self) -> str:
        return f"{self.role} {self.source} ({self.dataset})"


@dataclass(frozen=True)
class ReferenceEpisode:
    """An episode that buffers are planned from: a lesson, a unit of the pool, or a further one."""

    dataset: Annotated[str, "Name of the dataset in the buffer set, such as `demonstrations`."]
    episode: Annotated[EpisodeId, "Its id; units are of train episodes."]
    frames: Annotated[int, "Frames of the lesson or unit."]
    digests: Annotated[
        dict[str, str], "`feature_sha256` of its record, without actions; empty if unknown."
    ]


@dataclass(frozen=True)
class ReferenceQuery:
    """The buffers of a query episode."""

    episode: Annotated[EpisodeId, "The query episode."]
    sessions: Annotated[
        tuple[ReferenceSession, ...], "The distinct sessions of its buffers, by first use."
    ]
    buffers: Annotated[
        dict[str, tuple[int, ...]], "Condition to the buffer: positions in `sessions`, in order."
    ]

    def __post_init__(self) -> None:
        for condition, positions in self.buffers.items():
            if not all(0 <= position < len(self.sessions) for position in positions):
                raise FormatError(
                    f"{self.episode} under {condition} has the sessions {list(positions)}; "
                    f"expected positions from 0 to {len(self.sessions) - 1}"
                )

    def buffer(self, condition: str) -> tuple[ReferenceSession, ...]:
        """Return the sessions under a condition, in order."""
        return tuple(self.sessions[position] for position in self.buffers[condition])


@dataclass(frozen=True)
class ReferencePlan:
    """A reference plan, a JSON file: the buffers of a buffer set, and what they are planned from.

    The draw of units follows from `rule_version`, `seed`, the ids of the distractors in `episodes`
    and the id of the query (see `draw.py`).
    """

    format_version: Annotated[int, "Of the file."]
    rule_version: Annotated[int, "Version of the rule of the draw."]
    seed: Annotated[int, "Seed of the draw."]
    simulators: Annotated[tuple[str, ...], "Simulators of the demonstrations."]
    unit: Annotated[dict[str, int], "`frames` and `stride` of a distractor unit."]
    conditions: Annotated[tuple[str, ...], "Names of the conditions, in order."]
    renderers: Annotated[
        dict[str, str | None],
        "Dataset to the renderer whose images `digests` are of; None if unknown or without images.",
    ]
    episodes: Annotated[tuple[ReferenceEpisode, ...], "All lessons, all units of the pool, …."]
    queries: Annotated[tuple[ReferenceQuery, ...], "The queries, in canonical order."]
