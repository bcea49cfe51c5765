"""Where data comes from, and what it is not good for."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from robomme_interference_data.constants import FAMILIES, IDENTITY_PATH
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.outcomes import TEST_EPISODES
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.simulators.registry import SIMULATORS, simulator_class
from robomme_interference_data.storage.files import sha256_file

from .markdown import code, escape
from .publication import check_repo_id, is_commit

Rows = list[tuple[str, Any]]
"""Names and values of a table of provenance; Markdown."""


def is_whole_grid(records: Sequence[EpisodeRecord]) -> bool:
    """Tell whether queries are the paper's: nine families, test episodes 0 to 49 each."""
    ids = {(one.episode_id.family, one.episode_id.split, one.episode_id.index) for one in records}
    return ids == {(f, "test", n) for f in FAMILIES for n in range(TEST_EPISODES)}


def origin_limit(simulators: Sequence[str]) -> str:
    """Return where episodes come from, in a sentence."""
    known = {name: simulator_class(name).about for name in SIMULATORS}
    known["sample"] = "sample, made-up pictures without content, for trying the tools out"
    named = [known.get(name, f"the simulator {name}") for name in simulators]
    if not named:
        return "The recordings name no simulator."
    return f"The episodes come from {'; and from '.join(named)}."


def data_limits(
    queries: Sequence[EpisodeRecord], simulators: Sequence[str], more: Iterable[str]
) -> list[str]:
    """Return what data is not good for, as plain text, a sentence or two each."""
    found = [origin_limit(simulators)]
    if not is_whole_grid(queries):
        found.append(
            f"{len(queries):,} query episode{'s' * (len(queries) != 1)}, not the paper's grid of "
            f"{len(FAMILIES)} families × {TEST_EPISODES} test episodes: rates over these are not "
            "rates over the benchmark."
        )
    if any(record.episode_id.split == "test" for record in queries):
        found.append(
            "Test episodes are for evaluation. A policy that was trained on their demonstrations, "
            "goals or scenes is not measured by them."
        )
    found.append(
        "A lesson shows the answer to its own query, and the history is recorded, not what the "
        "robot itself went through: nothing here measures learning from failure, or forgetting by "
        "a policy's own training."
    )
    return [*found, *more]


def repositories_of(dataset: Dataset) -> dict[str, str | None]:
    """Return the repositories that a dataset was built from, and the commit of each."""
    found: dict[str, str | None] = {}
    for one in dataset.identity.sources:
        repo, revision = one.get("repo"), one.get("revision")
        with suppress(InvalidOptionError):  # whoever wrote the data may have written anything
            found[check_repo_id(repo)] = str(revision) if is_commit(revision) else None
    return found


def source_kinds_of(datasets: Iterable[Dataset]) -> list[str]:
    """Return the kinds of the sources that datasets were built from, such as `robomme-h5`."""
    kinds = {one.get("kind") for dataset in datasets for one in dataset.identity.sources}
    return sorted(kind for kind in kinds if isinstance(kind, str))


def source_details(datasets: Mapping[str, Dataset]) -> dict[str, Any]:
    """Return what is recorded of the sources of datasets, by titles."""
    found = {name: list(dataset.identity.sources) for name, dataset in datasets.items()}
    return {f"Sources of the {name}": sources for name, sources in found.items() if sources}


def dataset_rows(dataset: Dataset, name: str = "") -> Rows:
    """Return provenance of a dataset; `name` tells it from the others of a buffer set."""
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
    ]
