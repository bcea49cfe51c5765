"""Whether the datasets of a buffer set fit each other, and the conditions that are planned."""

import shlex
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    RAW_DISTRACTORS,
    SHIFTED,
    STATE,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import SourceError, named
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import Condition

from .alike import differences, in_buffers, unequal


def check_needs(
    conditions: Iterable[Condition], available: Collection[str], root: Path | None = None
) -> None:
    """Check that all datasets that conditions need are available; `root` is the set's folder."""
    where = "BUFFER_SET" if root is None else shlex.quote(str(root))
    for condition in conditions:
        for name in condition.kind.needs:
            if name not in available:
                raise SourceError(
                    f"{condition} needs the dataset {name}, which the buffer set lacks",
                    f"Build it first, or leave {condition} out.",
                    f"build {where} --only {name} --source KIND:PATH",
                )


def check_features(datasets: Mapping[str, Dataset]) -> None:
    """Check that sessions of all datasets can follow one another in a buffer."""
    base = datasets[DEMONSTRATIONS]
    for name, dataset in datasets.items():
        expected, found = (
            in_buffers(name, compared.features, compared.fps) for compared in (base, dataset)
        )
        if clauses := differences((f"the {DEMONSTRATIONS}", expected), (f"the {name}", found)):
            raise SourceError(
                "sessions of the datasets cannot follow one another in a buffer: "
                + "; ".join(clauses),
                f"Build all with the same {named('cameras')} and {named('resize')}, from sources "
                "with the same rates.",
            )
    if RAW_DISTRACTORS in datasets and DISTRACTORS in datasets:
        sizes = [datasets[name].features[STATE] for name in (DISTRACTORS, RAW_DISTRACTORS)]
        if sizes[0] != sizes[1]:
            raise SourceError(
                f"the {DISTRACTORS} have {sizes[0][0]} state values, the {RAW_DISTRACTORS} "
                f"{sizes[1][0]}",
                "Build both from the same sources.",
            )


def check_scenes(shifted: Dataset, base: Dataset) -> None:
    """Check that the views under shifts show the scenes of all demonstrations."""
    sources, expected = ([*dataset.identity.sources] for dataset in (shifted, base))
    views, queries = ({r.episode_id for r in dataset.records()} for dataset in (shifted, base))
    problem = f"lacks {min(queries - views)}" if queries - views else ""
    if other := [source for source in sources if source not in expected]:
        nearest = next(
            (source for source in expected if source["kind"] == other[0]["kind"]), expected[0]
        )
        found = unequal(("it", other[0]), (f"the {DEMONSTRATIONS}", nearest))
        problem = f"is of another source: {'; '.join(found)}"
    if problem:
        raise SourceError(
            f"{shifted.files.describe()} {problem}",
            "Build it from all query episodes, or remove it.",
            f"build BUFFER_SET --only {SHIFTED} --source KIND:PATH",
        )


def check_executions(executions: Dataset, base: Dataset) -> None:
    """Check that every execution follows a demonstration: the same goals, seed and difficulty."""

    def recorded(dataset: Dataset) -> dict[EpisodeId, dict[str, object]]:
        return {
            record.episode_id: {
                "goals": " / ".join(record.goals),
                "seed": record.seed,
                "difficulty": record.difficulty,
                "simulator": record.simulator,
            }
            for record in dataset.records()
        }

    expected = recorded(base)
    for episode, metadata in recorded(executions).items():
        if metadata != expected.get(episode):
            found = [f"the {DEMONSTRATIONS} lack it"]
            if episode in expected:
                found = unequal(("it", metadata), (f"the {DEMONSTRATIONS}", expected[episode]))
            raise SourceError(
                f"{executions.files.describe()}: {episode} is of another recording: "
                + "; ".join(found),
                "Build both from the same recordings.",
                f"build BUFFER_SET --only {EXECUTIONS} --source KIND:PATH",
            )
