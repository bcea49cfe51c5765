"""What buffers are made of: the datasets of a split, and the sessions that conditions ask for.

Rules 1 to 5 of the protocol; the draw itself is `draw.py`.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from robomme_interference_data.constants import (
    ACTION,
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    FURTHER,
    IDENTITY_PATH,
    POSITION_LIMIT,
    RAW_DISTRACTORS,
    SHIFTED,
    UNIT_FRAMES,
    UNITS,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import FormatError, InvalidOptionError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, Condition, in_order
from robomme_interference_data.schema.draw import UnitPool
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import Files, LocalFiles


@dataclass(frozen=True)
class ManifestPlan:
    """All that decides the manifests.

    Attributes:
        datasets: The datasets of the split by name: the query episodes, and what sessions are of.
        conditions: For which buffers are planned, in order.
        seed: Seed of the draw.
        position_limit: Longest history plus rollout that the systems hold; None for no limit.
    """

    datasets: Mapping[str, Dataset]
    conditions: tuple[Condition, ...]
    seed: int = 0
    position_limit: int | None = POSITION_LIMIT

    @property
    def demonstrations(self) -> Dataset:
        """The query episodes."""
        return self.datasets[DEMONSTRATIONS]

    @cached_property
    def pool(self) -> UnitPool:
        """The units, to be drawn."""
        return UnitPool((one.episode_id for one in self.datasets[DISTRACTORS].records()), self.seed)

    def session(self, dataset: str, episode: EpisodeId) -> SessionEntry:
        """Return the session that an episode of a dataset of units or contradictions is.

        Raises:
            SourceError: The dataset does not hold it.
        """
        found = self._sessions[dataset].get(episode)
        if found is None:
            where = self.datasets[dataset].files.describe()
            raise SourceError(
                f"{where} does not hold {episode}, of which a session is needed",
                f"Build it of the same episodes: robomme-interference build {dataset}",
            )
        return found

    @cached_property
    def _sessions(self) -> dict[str, dict[EpisodeId, SessionEntry]]:
        """The sessions of datasets; contradictions by the query that they contradict."""
        return {
            name: {
                one.episode_id.scene: dataset.session(ROLE_OF[name], one)
                for one in dataset.records()
            }
            for name, dataset in self.datasets.items()
            if name in ROLE_OF
        }


ROLE_OF = {
    DEMONSTRATIONS: "lesson",
    DISTRACTORS: "distractor",
    RAW_DISTRACTORS: "distractor",
    CONTRADICTIONS: "contradiction",
}
"""What a session is to a query, by the dataset that it is of."""


def in_folder(root: Path) -> dict[str, Files]:
    """Return where the datasets of a split lie that is built in a folder."""
    further = (name for name in FURTHER if (root / name / IDENTITY_PATH).is_file())
    return {name: LocalFiles(root / name) for name in (DEMONSTRATIONS, DISTRACTORS, *further)}


def plan_manifests(
    places: Mapping[str, Files],
    conditions: Sequence[str | Condition] = DEFAULT_CONDITIONS,
    seed: int = 0,
    position_limit: int | None = POSITION_LIMIT,
) -> ManifestPlan:
    """Check that the datasets of a split and the options fit each other.

    Args:
        places: Where the datasets of the split lie, by name; see `in_folder`.
        conditions: For which buffers are planned.
        seed: Seed of the draw.
        position_limit: See `ManifestPlan`.

    Raises:
        InvalidIdError, InvalidOptionError: A condition is none, or comes twice.
        MissingFileError, FormatError: A dataset is missing or damaged.
        SourceError: The datasets do not fit each other, a unit is not of the train split, or
            conditions need a dataset that is not there.
    """
    ordered = in_order(conditions)
    check_needs(ordered, places)
    opened = {}
    for name, files in places.items():
        opened[name] = dataset = Dataset(files)
        if dataset.kind != name:
            raise InvalidOptionError(
                f"{files.describe()} is a dataset of {dataset.kind}",
                f"Put there what robomme-interference build {name} made.",
            )
    _check_features(opened)
    for name in UNITS.keys() & opened.keys():
        splits = {record.episode_id.split for record in opened[name].records()}
        if splits != {"train"}:
            raise SourceError(
                "distractor units must come from train episodes, so that no query's own scene "
                f"leaks into another buffer; found {', '.join(sorted(splits))}",
                f"Build the {name} with --split train.",
            )
    if SHIFTED in opened:
        _check_scenes(opened[SHIFTED], opened[DEMONSTRATIONS])
    return ManifestPlan(opened, ordered, seed, position_limit)


def check_needs(conditions: Iterable[Condition], there: Collection[str]) -> None:
    """Check that a split has the datasets that conditions need.

    Args:
        conditions: The conditions.
        there: Names of the datasets that it has.

    Raises:
        SourceError: One is not there.
    """
    for condition in conditions:
        for name in condition.kind.needs:
            if name not in there:
                raise SourceError(
                    f"{condition} needs the dataset {name}, which the split lacks",
                    f"Build it first: robomme-interference build {name} --source KIND:PATH "
                    f"--out SPLIT/{name}. Or leave {condition} out.",
                )


def _check_features(datasets: Mapping[str, Dataset]) -> None:
    """Check that sessions of all datasets can follow one another in a buffer."""
    shown = {
        name: {feature: s for feature, s in one.features.items() if feature != ACTION}
        for name, one in datasets.items()
    }
    for name, features in shown.items():
        if features != shown[DEMONSTRATIONS]:
            raise SourceError(
                "sessions of the datasets cannot follow one another in a buffer: the "
                f"demonstrations have {shown[DEMONSTRATIONS]}, the {name} {features}",
                "Build all with the same --cameras, from sources with the same sizes.",
            )


def _check_scenes(shifted: Dataset, base: Dataset) -> None:
    """Check that views under shifts are of the scenes of the demonstrations, and of all."""
    found, wanted = ([*one.identity.sources] for one in (shifted, base))
    why = f"was built from {found}, the demonstrations from {wanted}"
    if all(one in wanted for one in found):
        there, asked = ({r.episode_id for r in one.records()} for one in (shifted, base))
        why = f"lacks {min(asked - there)}" if asked - there else ""
    if why:
        raise SourceError(
            f"{shifted.files.describe()} {why}",
            f"Build it of all query episodes: robomme-interference build {SHIFTED}, or remove it.",
        )


class QueryMaterial:
    """What the conditions' rules make the history of one query of; see `conditions.Material`."""

    def __init__(self, plan: ManifestPlan, record: EpisodeRecord):
        self._plan = plan
        self._record = record
        self._drawn: dict[bool, list[EpisodeId]] = {False: [], True: []}

    def lesson(self, part: str = "lesson") -> SessionEntry:
        """Return the lesson, or a part of it."""
        record = self._record
        whole = self._plan.session(DEMONSTRATIONS, record.episode_id)
        if part == "lesson":
            return whole
        if part not in record.spans or record.span_sha256 is None:
            where = self._plan.demonstrations.files.describe()
            raise FormatError.damaged(where, f"{record.episode_id}: no digests of its parts")
        start, stop = record.spans[part]
        sha256 = getattr(record.span_sha256, part)
        found = replace(whole, start=start, stop=stop, sha256=sha256)
        return replace(found, role="filler", repeat=UNIT_FRAMES) if part == "last" else found

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        """Return the units that are drawn for the query, or the raw ones of the same episodes."""
        return [self._plan.session(dataset, unit) for unit in self._draw(k, own=False)]

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        """Return the units of the query's own family that are drawn for it."""
        return [self._plan.session(DISTRACTORS, unit) for unit in self._draw(k, own=True)]

    def contradiction(self) -> SessionEntry:
        """Return the lesson in the query's scene with another answer."""
        return self._plan.session(CONTRADICTIONS, self._record.episode_id)

    def _draw(self, k: int, *, own: bool) -> Sequence[EpisodeId]:
        if k > len(self._drawn[own]):  # fewer begin those that are drawn
            draw = self._plan.pool.draw_own if own else self._plan.pool.draw
            self._drawn[own] = draw(self._record.episode_id, k)
        return self._drawn[own][:k]
