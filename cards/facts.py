"""What cards state, computed from data: `Facts` for a template, with sources and limits."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from robomme_interference_data.constants import FAMILIES, IDENTITY_PATH, RECORDINGS
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError, counted
from robomme_interference_data.evaluate.score.outcomes import TEST_EPISODES
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class
from robomme_interference_data.storage.files import sha256_file

from .markdown import code, escape
from .publication import check_repo_id, is_commit

ProvenanceRows = list[tuple[str, Any]]
"""Names and values of a table of provenance, in Markdown."""


@dataclass(frozen=True)
class CardTable:
    """A table of a repository that `datasets.load_dataset` finds.

    `record` is the dataclass of its rows; `split` the name under which they load: the split of all
    its episodes, such as `test`, or `mixed`.
    """

    name: str
    record: type
    path: str
    split: str


@dataclass(frozen=True)
class Facts:
    """What a card states, computed from data; `kind` is the name of its template.

    `examples` counts stored frames or rollouts; the first of `tables` loads by default. `limits`
    and `provenance` are plain text and Markdown; `pictures` draws files of the card by path, and
    `values` are further values of the template. `base` is the location of what the data was made
    for, which `base_kind` names. `repositories` on the Hub (with commits) are what it was built
    from. `details` are shown as JSON.
    """

    kind: str
    title: str
    examples: int
    tables: Sequence[CardTable]
    simulators: Sequence[str]
    simulated: bool
    limits: Sequence[str]
    provenance: ProvenanceRows
    pictures: Callable[[], Mapping[str, bytes]]
    values: Mapping[str, Any]
    base_kind: str | None = None
    base: object = None
    repositories: Mapping[str, str | None] = field(default_factory=dict)
    details: Mapping[str, Any] = field(default_factory=dict)
    tags: Sequence[str] = ("LeRobot",)


# --- limits --------------------------------------------------------------------------------------


def is_whole_grid(records: Sequence[EpisodeRecord]) -> bool:
    """Return whether queries are those of the paper: nine families, test episodes 0 to 49 each."""
    ids = {
        (record.episode_id.family, record.episode_id.split, record.episode_id.index)
        for record in records
    }
    return ids == {(family, "test", index) for family in FAMILIES for index in range(TEST_EPISODES)}


def origin_limit(simulators: Sequence[str]) -> str:
    """Return where episodes come from, in a sentence."""
    known = {name: simulator_class(name).about for name in SIMULATORS}
    known[RECORDINGS] = simulator_class(RECORDINGS).about
    known["sample"] = "sample, made-up pictures without content, for trying the tools out"
    named = [known.get(name, f"the simulator {name}") for name in simulators]
    if not named:
        return "The recordings name no simulator."
    return f"The episodes come from {'; and from '.join(named)}."


def data_limits(
    queries: Sequence[EpisodeRecord], simulators: Sequence[str], more: Iterable[str]
) -> list[str]:
    """Return what data is not suitable for, as plain text."""
    limits = [origin_limit(simulators)]
    if not is_whole_grid(queries):
        limits.append(
            f"{counted(len(queries), 'query episode')} instead of the paper's "
            f"{len(FAMILIES)} families × {TEST_EPISODES} test episodes: success rates are not "
            "comparable with those of the benchmark."
        )
    if any(record.episode_id.split == "test" for record in queries):
        limits.append(
            "Test episodes are for evaluation. They do not measure a policy that was trained on "
            "their demonstrations, goals or scenes."
        )
    limits.append(
        "The lesson shows the solution of its own query, and the history is a recording, not the "
        "robot's own experience: the data does not measure learning from failure, or forgetting "
        "through a policy's own training."
    )
    return [*limits, *more]


# --- sources -------------------------------------------------------------------------------------


def repositories_of(dataset: Dataset) -> dict[str, str | None]:
    """Return the repositories that a dataset was built from, and their commits."""
    repositories: dict[str, str | None] = {}
    for source in dataset.identity.sources:
        repo, revision = source.get("repo"), source.get("revision")
        with suppress(InvalidOptionError):  # the data is untrusted
            repositories[check_repo_id(repo)] = str(revision) if is_commit(revision) else None
    return repositories


def dataset_rows(dataset: Dataset, name: str = "") -> ProvenanceRows:
    """Return the provenance of a dataset; `name` distinguishes the datasets of a buffer set."""
    identity, of = dataset.identity, f" of the {escape(name)}" if name else ""
    digest = sha256_file(dataset.files.path(IDENTITY_PATH))
    return [
        (f"revision of the content{of}", code(identity.revision)),
        (f"SHA-256 of `{IDENTITY_PATH}`{of}", code(digest)),
        (f"codec{of}", code(identity.codec)),
        *(
            (f"source{of}", code(f"{repo}@{commit}" if commit else repo))
            for repo, commit in repositories_of(dataset).items()
        ),
        *(
            (f"renderer{of}", code(source["renderer"]))
            for source in identity.sources
            if source.get("renderer")
        ),
    ]
