"""Reference plans: make one from a buffer set, write it and read it."""

from collections import defaultdict
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

from robomme_interference_data.constants import (
    ACTION,
    DATASETS,
    DEMONSTRATIONS,
    DISTRACTORS,
    FORMAT_VERSION,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.data.renderers import dataset_renderers
from robomme_interference_data.errors import InvalidOptionError, nearest
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import datasets_of, in_order
from robomme_interference_data.schema.reference_plan import (
    ReferenceEpisode,
    ReferencePlan,
    ReferenceQuery,
    ReferenceSession,
)
from robomme_interference_data.storage.files import write_text
from robomme_interference_data.storage.text import canonical_json, read_header

PLANS = ("official", "tutorial")
"""Reference plans that this package holds."""


def reference_plan(buffer_set: BufferSet) -> ReferencePlan:
    """Return the plan of a buffer set, with the digests that its episodes record.

    Raises:
        MissingFileError: It is a partial copy.
    """
    buffer_set.check_is_whole()
    header = buffer_set.header
    names = datasets_of(in_order(header.conditions))
    datasets = {name: buffer_set.datasets[name] for name in names}
    episodes = []
    for name, dataset in datasets.items():
        for record in dataset.records():
            start, stop = record.session
            digests = {
                feature: digest
                for feature, digest in record.feature_sha256.items()
                if feature != ACTION
            }
            episodes.append(ReferenceEpisode(name, record.episode_id, stop - start, digests))
    return ReferencePlan(
        format_version=FORMAT_VERSION,
        rule_version=header.rule_version,
        seed=header.seed,
        simulators=datasets[DEMONSTRATIONS].identity.simulators,
        unit=datasets[DISTRACTORS].unit.recorded(),
        conditions=header.conditions,
        renderers=dataset_renderers(datasets),
        episodes=tuple(sorted(episodes, key=_order)),
        queries=tuple(sorted(_queries(buffer_set), key=lambda query: query.episode)),
    )


def _order(episode: ReferenceEpisode) -> tuple[int, EpisodeId]:
    return DATASETS.index(episode.dataset), episode.episode


def _queries(buffer_set: BufferSet) -> Iterator[ReferenceQuery]:
    buffers = defaultdict[EpisodeId, dict[str, tuple[ReferenceSession, ...]]](dict)
    for manifest in buffer_set.planned_manifests():
        buffers[manifest.episode_id][manifest.condition] = tuple(
            ReferenceSession(entry.role, entry.dataset, entry.source) for entry in manifest.sessions
        )
    for episode, sessions in buffers.items():
        used = dict.fromkeys(session for buffer in sessions.values() for session in buffer)
        position = {session: number for number, session in enumerate(used)}
        positions = {
            condition: tuple(position[session] for session in buffer)
            for condition, buffer in sessions.items()
        }
        yield ReferenceQuery(episode, tuple(used), positions)


def plan_text(plan: ReferencePlan) -> str:
    """Return the text of the file: JSON with a line for each episode and query."""
    fields = []
    for name, value in sorted(to_dict(plan).items()):
        text = canonical_json(value)
        if name in ("episodes", "queries"):
            text = "[\n" + ",\n".join(map(canonical_json, value)) + "\n]"
        fields.append(f"{canonical_json(name)}: {text}")
    return "{\n" + ",\n".join(fields) + "\n}\n"


def write_plan(plan: ReferencePlan, path: Path) -> None:
    """Write a reference plan, whole or not at all."""
    write_text(path, plan_text(plan))


def read_plan(plan: str) -> ReferencePlan:
    """Return a reference plan, given its name, its file, or a buffer set with that plan.

    Raises:
        InvalidOptionError: It is none of these.
        FormatError: It is damaged, or of another format version.
    """
    if plan in PLANS:
        plans = resources.files(__package__) / "plans"
        with resources.as_file(plans / f"{plan}.json") as path:
            return read_header(path, ReferencePlan)
    path = Path(plan).expanduser()
    if path.is_file():
        return read_header(path, ReferencePlan)
    if path.is_dir() or "/" in plan:
        return reference_plan(load_buffer_set(plan))
    raise InvalidOptionError.expected(
        "against",
        plan,
        f"{', '.join(PLANS)}, a file that --write-plan wrote, or a buffer set",
        nearest(plan, PLANS),
    )
