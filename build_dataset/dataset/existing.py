"""The dataset that a build extends: its episodes are not encoded again."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from robomme_interference_data.build_dataset.alike import same_rate, unequal
from robomme_interference_data.build_dataset.sources.base import Robot
from robomme_interference_data.build_dataset.sources.lerobot.columns import recorded_robot
from robomme_interference_data.build_dataset.sources.simulator import SimulatorSource
from robomme_interference_data.constants import (
    ACTION,
    CAMERA_PREFIX,
    DISTRACTORS,
    IDENTITY_PATH,
    REPORT_PATH,
    STATE,
    UNITS,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.lerobot.statistics import (
    Statistics,
    before_scaling,
    episode_statistics,
)
from robomme_interference_data.storage.text import read_header

from .identity import BuildReport
from .lerobot_writer import StoredEpisode
from .plan import DatasetPlan
from .same_simulators import check_same_simulators


def _advice(extend: Mapping[str, object] | None = None) -> str:
    """Return what to do about a dataset that a build does not extend.

    Args:
        extend: The settings with which it would, and their values; None for a setting to leave out.
    """
    advice = f"Choose another {named('buffer_set')}, or remove the folder first."
    if not extend:
        return advice
    ways = [
        f"without {named(name)}" if value is None else f"with {named(name, value)}"
        for name, value in extend.items()
    ]
    return f"To extend it, build {', '.join(ways)}. {advice}"


@dataclass(frozen=True)
class ExistingDataset:
    """A dataset that a build extends: its episodes, and the skipped ids with the reasons."""

    dataset: Dataset
    episodes: tuple[StoredEpisode, ...]
    skipped: dict[str, str]

    @property
    def ids(self) -> set[EpisodeId]:
        """Ids of its episodes."""
        return {episode.record.episode_id for episode in self.episodes}


def open_existing(out: Path, plan: DatasetPlan) -> ExistingDataset | None:
    """Open the dataset that a build extends; None if there is none."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / IDENTITY_PATH).is_file():
        raise BuildError(f"{out} exists and is not a dataset of this package", _advice())
    dataset = Dataset(LocalFiles(out))
    identity = dataset.identity
    existing = {
        "kind": identity.kind,
        "version": identity.version,
        "codec": identity.codec,
        "cameras": ", ".join(identity.cameras) or "none",
        "resize": _resize_of(dataset),
    }
    planned = {"kind": plan.kind, "version": plan.version, "codec": plan.codec}
    cameras = identity.cameras if plan.cameras is None else plan.cameras
    planned["cameras"] = ", ".join(cameras) or "none"
    planned["resize"] = "none" if plan.resize is None else str(plan.resize)
    if found := unequal(("it", existing), ("this build", planned)):
        extend = {
            "codec": identity.codec,
            "version": identity.version,
            "cameras": ",".join(identity.cameras) or "none",
            "resize": None if existing["resize"] == "none" else existing["resize"],
        }
        differ = {name: value for name, value in extend.items() if existing[name] != planned[name]}
        raise BuildError(
            f"{out} exists with other settings: {'; '.join(found)}",
            # No setting makes a dataset of another kind of it.
            _advice(differ if existing["kind"] == planned["kind"] else None),
        )
    if plan.kind in UNITS and dataset.unit != plan.unit.in_dataset(plan.kind):
        unit = dataset.unit
        of_units: dict[str, object] = {
            "unit": f"{unit.frames}x{unit.stride}",
            "units_per_episode": unit.per_episode,
        }
        raise BuildError(
            f"{out} exists with units of {unit}, not of {plan.unit.in_dataset(plan.kind)}",
            # Units at full rate do not show the stride of the others, which they follow from.
            _advice(of_units if plan.kind == DISTRACTORS else None),
        )
    check_same_simulators(
        str(out),
        identity.sources,
        plan.provenances,
        f"choose another {named('buffer_set')}, or remove the folder first.",
    )
    if plan.fps is not None and not same_rate(plan.fps, dataset.fps):
        raise InvalidOptionError(
            f"{named('fps')} is {plan.fps:g}; {out} has {dataset.fps:g} frames per second",
            f"Leave it out, or choose another {named('buffer_set')}.",
            option="fps",
        )
    _check_recordings(out, dataset, plan)
    features = [CAMERA_PREFIX + camera for camera in dataset.cameras]
    statistics = episode_statistics(LeRobotFiles(dataset.files, statistics=features).table)
    vectors = {name: (name,) for name in (STATE, ACTION) if name in dataset.lerobot.features}
    robot = recorded_robot(dataset.lerobot, vectors)
    episodes = map(partial(_stored, dataset, robot), dataset.records(), statistics)
    report = read_header(out / REPORT_PATH, BuildReport)
    return ExistingDataset(dataset, tuple(episodes), report.reasons)


def _resize_of(dataset: Dataset) -> str:
    """Return how the frames of a dataset were resized: the same for all of its sources."""
    sizes = {str(source.get("resize", "none")) for source in dataset.identity.sources}
    return ", ".join(sorted(sizes)) or "none"


def _check_recordings(out: Path, dataset: Dataset, plan: DatasetPlan) -> None:
    """Check that recordings are those that the dataset was built from: one of each source.

    Simulators, and repositories at a recorded commit, are the same by what is recorded of them.
    """
    known = {record.episode_id: record for record in dataset.records()}
    for number, source in enumerate(plan.sources):
        again = [
            episode for owner, episode in plan.episodes if owner == number and episode.id in known
        ]
        if not again or isinstance(source, SimulatorSource):
            continue
        provenance = plan.provenance(number)
        if "revision" in provenance and provenance in dataset.identity.sources:
            continue
        recording, record = source.read(again[0], plan.cameras), known[again[0].id]
        recording.frames.close()
        given = dataset.fps if plan.fps is None else plan.fps
        rate = given if recording.robot.fps is None else recording.robot.fps
        names = ("goals", "seed", "difficulty")
        stored = {name: getattr(record, name) for name in names}
        facts = {name: getattr(recording, name) for name in names}
        if not same_rate(rate, dataset.fps):
            stored["frames per second"] = dataset.fps
            facts["frames per second"] = rate
        if found := unequal((str(out), stored), ("this source", facts)):
            raise SourceError(
                f"{record.episode_id} exists with another recording: {'; '.join(found)}", _advice()
            )


def _stored(
    dataset: Dataset, robot: Robot, record: EpisodeRecord, statistics: Statistics
) -> StoredEpisode:
    lerobot, index = dataset.lerobot, record.episode_index
    stats = {
        feature: {
            name: before_scaling(name, values) for name, values in statistics[feature].items()
        }
        for feature in lerobot.video_features
    }
    videos = {
        feature: dataset.files.path(lerobot.locate_video(index, feature).path)
        for feature in lerobot.video_features
    }
    vectors = partial(lerobot.vectors, index)
    return StoredEpisode(record, dataset.features, videos, stats, vectors, robot)
