"""Play the episodes of a buffer set again on their simulator, and compare them with its records.

Digests tell whether data was changed after a build; only the simulator tells whether evidence,
goals and frames were ever right.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

from robomme_interference_data.build_dataset.dataset.frame_selection import (
    NothingToStore,
    select_frames,
)
from robomme_interference_data.build_dataset.sources import (
    Recording,
    Source,
    SourceEpisode,
    open_source,
)
from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    DISTRACTORS,
    IDENTITY_PATH,
    LESSONS,
    PAPER_UNIT,
    SHIFTED,
    STATE,
    UNITS,
    Unit,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import (
    SAME_FOR_ALL,
    InterferenceError,
    InvalidOptionError,
    first_line,
    named,
    naming_options,
    option_names,
)
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Executor, Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.records import Day, EpisodeRecord, EvidenceSpan
from robomme_interference_data.simulators.registry import simulator_class
from robomme_interference_data.storage.arrays import FeatureDigests, combine

from .dataset import Violation
from .planned_again import difference


@dataclass(frozen=True)
class PlayedDataset:
    """A dataset whose episodes are played again.

    Attributes:
        name: Its name in the buffer set.
        source: The simulator.
        cameras: The cameras that it stores.
        unit: Size of its units, as in the distractors.
        states: Whether states and actions must be equal too: the renderer is the recorded one.
        frames: Whether images must be, too: in addition, versions and options are the recorded
            ones, and the images were not changed by a build.
    """

    name: str
    source: Source
    cameras: tuple[str, ...]
    unit: Unit
    states: bool
    frames: bool


@dataclass(frozen=True)
class ReplayTask:
    """Plays episodes one by one, as a task of an executor.

    Attributes:
        datasets: The datasets by name.
        option_names: How errors name settings, also in another process.
    """

    datasets: Mapping[str, PlayedDataset]
    option_names: Mapping[str, str] = field(default_factory=option_names)

    def __call__(self, task: tuple[int, tuple[str, EpisodeRecord]], worker: Worker) -> list[str]:
        """Play an episode of a dataset, which comes with its number; return how it differs."""
        _, (name, record) = task
        with naming_options(self.option_names):
            try:
                return [*_differences(self.datasets[name], record)]
            except SAME_FOR_ALL:
                raise
            except (InterferenceError, NothingToStore) as error:
                return [f"cannot be played again: {first_line(error)}"]

    def close(self) -> None:
        """Close the simulators."""
        for dataset in self.datasets.values():
            dataset.source.close()


@dataclass(frozen=True)
class Replay:
    """What is played again, and the violations that show before.

    Attributes:
        datasets: The datasets by name.
        episodes: The records of the episodes, each with the name of its dataset.
        violations: Datasets of other versions of the simulator, which are not played.
    """

    datasets: Mapping[str, PlayedDataset]
    episodes: Sequence[tuple[str, EpisodeRecord]]
    violations: Sequence[Violation]

    @property
    def without_states(self) -> list[str]:
        """Names of the datasets whose states and actions are not compared."""
        return [dataset.name for dataset in self.datasets.values() if not dataset.states]

    @property
    def without_frames(self) -> list[str]:
        """Names of the datasets whose images are not compared."""
        return [dataset.name for dataset in self.datasets.values() if not dataset.frames]

    def run(self, executor: Executor, progress: WorkProgress) -> Iterator[Violation]:
        """Play the episodes; yield the violations in the order of the episodes.

        Raises:
            InvalidOptionError, MissingExtraError, SimulatorError: No episode can be played.
        """
        yield from self.violations
        found = dict[int, list[str]]()
        limit = max((played.source.time_limit_s for played in self.datasets.values()), default=None)
        progress.start("Playing", len(self.episodes))
        task = ReplayTask(self.datasets)
        with closing(executor.run(task, enumerate(self.episodes), time_limit=limit)) as outcomes:
            for outcome in outcomes:
                progress.advance(1)
                if isinstance(outcome.error, SAME_FOR_ALL):
                    raise outcome.error
                number, _ = outcome.task
                found[number] = outcome.value
                if outcome.error is not None:
                    found[number] = [f"cannot be played again: {first_line(outcome.error)}"]
        for number, (name, record) in enumerate(self.episodes):
            for what in found[number]:
                yield Violation(f"{name} {record.episode_id}", what)


def plan_replay(
    datasets: Mapping[str, Dataset],
    simulator: str,
    numbers: Collection[int] | None = None,
    *,
    simulator_python: str | None = None,
    simulator_options: Sequence[str] = (),
) -> Replay:
    """Choose the episodes that a simulator plays again: those of datasets that it recorded.

    Args:
        datasets: Datasets of a buffer set by name.
        simulator: The simulator, as for `make_simulator`. It is never taken from the data, which
            may name any module.
        numbers: Indices of the episodes; None for all.
        simulator_python: Its own interpreter, if it needs one; None for the default.
        simulator_options: Its own arguments, `NAME=VALUE`.

    Raises:
        UnknownNameError: There is no such simulator.
        InvalidOptionError: It recorded no dataset, or none of the episodes.
    """
    simulator_class(simulator)  # before anything else: it must be one
    played, violations = dict[str, PlayedDataset](), list[Violation]()
    kinds = {name: _kinds(dataset) for name, dataset in datasets.items()}
    recorded = {name: datasets[name] for name, found in kinds.items() if found == {simulator}}
    for name, dataset in recorded.items():
        unit = datasets[DISTRACTORS].unit if name in UNITS else PAPER_UNIT
        # As in a build: only the frames that a unit stores are drawn, if the first one is frame 0.
        every = unit.in_dataset(name).stride if name in UNITS and unit.per_episode == 1 else 1
        source = open_source(
            simulator,
            kind=name,
            shifted=name == SHIFTED,
            every=every,
            simulator_python=simulator_python,
            simulator_options=simulator_options,
        )
        stored = [*dataset.identity.sources]
        version = suite_version(simulator, source.provenance)
        if any(suite_version(simulator, entry) != version for entry in stored):
            what = f"sources are {stored}; {simulator} is {source.provenance} here"
            violations.append(Violation(f"{name}/{IDENTITY_PATH}", what))
            continue
        renderer = source.provenance.get("renderer")
        states = all(entry.get("renderer") == renderer for entry in stored)
        frames = stored == [source.provenance] and dataset.identity.exact
        played[name] = PlayedDataset(name, source, dataset.cameras, unit, states, frames)
    if not recorded:
        others = sorted(set().union(*kinds.values()))
        raise InvalidOptionError(
            f"no dataset was recorded on the simulator {simulator}; the sources are "
            f"{', '.join(others)}",
            f"Give the simulator that recorded them, or leave {named('replay')} out.",
        )
    episodes = [
        (name, record)
        for name in played
        for record in datasets[name].records()
        if numbers is None or record.episode_id.index in numbers
    ]
    if played and not episodes:
        raise InvalidOptionError(
            "none of the given episodes is in the datasets",
            f"Change {named('episodes')}, or leave it out.",
        )
    return Replay(played, episodes, violations)


def _kinds(dataset: Dataset) -> set[str]:
    return {str(source.get("kind")) for source in dataset.identity.sources}


def suite_version(simulator: str, provenance: Mapping[str, Any]) -> object:
    """Return the version of the episodes: see `Simulator.versions`."""
    declared, versions = simulator_class(simulator), provenance.get("versions")
    if not isinstance(versions, Mapping):
        return None
    return versions.get(declared.name or declared.__name__)


def _differences(dataset: PlayedDataset, record: EpisodeRecord) -> Iterator[str]:
    """Play an episode, and yield how its record differs."""
    source = dataset.source
    episode = SourceEpisode(replace(record.episode_id, start=0))
    recording = source.read(episode, dataset.cameras)
    with closing(recording.frames):
        yield from _of_metadata(dataset.name, recording, record)
        count, session, query = 0, FeatureDigests(), FeatureDigests()
        start = record.episode_id.start
        for frame in select_frames(dataset.name, recording, dataset.unit, start):
            values: dict[str, Any] = {CAMERA_PREFIX + c: frame.images[c] for c in dataset.cameras}
            values[STATE] = frame.state
            if frame.action is not None:
                values[ACTION] = frame.action
            digests = session if count < record.session[1] else query
            for feature, value in values.items():
                digests.update(feature, value)
            count += 1
    if count != record.length:
        yield f"has {record.length} frames; played again, it has {count}"
        return
    played = session.current()
    for feature in sorted(played.keys() | record.feature_sha256.keys()):
        if not (dataset.frames if feature.startswith(CAMERA_PREFIX) else dataset.states):
            continue
        if played.get(feature) != record.feature_sha256.get(feature):
            yield f"{feature} is not what is seen when it is played again"
    if recording.day is not None and recording.day() != _without_digests(record.day):
        yield "its tasks, queries or evidence are others when it is played again"
    recorded = record.span_sha256
    if dataset.frames and recorded is not None and combine(query.current()) != recorded.query:
        yield "its first live observation is not what is seen when it is played again"


def _without_digests(day: Day | None) -> Day | None:
    """Return a day as its source describes it."""
    if day is None:
        return None
    return replace(day, spans=tuple(replace(span, sha256="") for span in day.spans))


def _of_metadata(name: str, recording: Recording, record: EpisodeRecord) -> Iterator[str]:
    """Yield how what is known of an episode differs from what its recording gives."""
    played = {
        "goals": recording.goals,
        "seed": recording.seed,
        "difficulty": recording.difficulty,
        "simulator": recording.simulator,
        "evidence": recording.evidence if name in LESSONS else None,
        "scene": recording.scene if name in LESSONS else None,
    }
    for known, value in played.items():
        stored = getattr(record, known)
        if stored != value:
            shown = difference(_plain(stored), _plain(value), "played again it is")
            yield f"{known} is {shown}"


def _plain(value: Any) -> Any:
    """Return evidence as lists of dicts, of which `difference` shows where they differ."""
    if not isinstance(value, tuple):
        return value
    return [to_dict(part) if isinstance(part, EvidenceSpan) else part for part in value]
