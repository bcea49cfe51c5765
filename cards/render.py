"""Cards as files: what a repository says of itself, all of it from data.

The same data, publication and version of this package (and, for the picture, of matplotlib) give
the same bytes.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    FPS,
    MAX_STEPS,
    POSITION_LIMIT,
    QUESTIONS_PATH,
    RECORDS_PATH,
    UNIT_FRAMES,
    UNIT_MIN_RAW_FRAMES,
    UNIT_STRIDE,
)
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.viz.tables import Table
from robomme_interference_data.viz.templates import fill

from . import citation, croissant
from .columns import Column, columns_of
from .facts import (
    LOSSY_SOURCE,
    DatasetFacts,
    SplitFacts,
)
from .film import Film, film_of_lesson, film_of_split
from .markdown import Raw, block, code, escape, quoted, table
from .metadata import (
    BUFFERS,
    BUFFERS_FILE,
    EPISODES,
    QUESTIONS,
    config,
    front_matter,
)
from .provenance import (
    as_json,
    dataset_rows,
    provenance,
    sources,
    split_rows,
)
from .publication import OTHER, Publication
from .results import ResultsFacts, results_values

README, STRIP, CROISSANT = "README.md", "README-strip.png", "croissant.json"
"""Files of a card, at the root of a repository."""


def demonstrations_files(dataset: Dataset, about: Publication) -> dict[str, bytes]:
    """Return the card of a dataset of demonstrations: its files by their path in the repository.

    Args:
        dataset: The demonstrations.
        about: As what they are published.

    Raises:
        InvalidOptionError: The dataset is one of distractor units, which are published with the
            manifests that name them.
        MissingExtraError: jinja2 or matplotlib is not installed.
        MissingFileError, FormatError: The dataset cannot be read.
    """
    facts = _demonstrations(dataset)
    text, film = _demonstrations_text(facts, about)
    data = croissant.of_demonstrations(facts, about)
    return {README: text.encode(), STRIP: film.png, CROISSANT: croissant.as_bytes(data)}


def split_files(split: Split, about: Publication) -> dict[str, bytes]:
    """Return the card of a split: its files by their path in the repository.

    Args:
        split: The split.
        about: As what it is published; `base` names the demonstrations; without it
            the manifests do.

    Raises:
        MissingExtraError: jinja2 or matplotlib is not installed.
        MissingFileError, FormatError: The split cannot be read.
    """
    facts = SplitFacts(split)
    about = about.made_for(facts.base)
    text, film = _split_text(facts, about)
    data = croissant.of_split(facts, about)
    return {README: text.encode(), STRIP: film.png, CROISSANT: croissant.as_bytes(data)}


def results_files(results: Score | Path, about: Publication) -> dict[str, bytes]:
    """Return the card of a run's results: its files by their path in the repository.

    The repository holds the files of the run's folder at its root. Pictures are
    `README-<simulator>.png`.

    Args:
        results: The folder of a run, a file of rows, or what either scored.
        about: As what they are published; `base` names the split, without it `run.json` does.

    Raises:
        InvalidOptionError: The score is of several runs.
        MissingExtraError: jinja2 or matplotlib is not installed.
        MissingFileError, FormatError: The rows cannot be scored.
    """
    facts = ResultsFacts.of(results)
    about = about.made_for(facts.base)
    data = croissant.of_results(facts, about)
    text = _results_text(facts, about)
    return {README: text.encode(), **facts.pictures(), CROISSANT: croissant.as_bytes(data)}


def demonstrations_text(dataset: Dataset, about: Publication) -> str:
    """Return the README of demonstrations alone, without drawing; see `demonstrations_files`."""
    return _demonstrations_text(_demonstrations(dataset), about)[0]


def split_text(split: Split, about: Publication) -> str:
    """Return the README of a split alone, without drawing; see `split_files`."""
    facts = SplitFacts(split)
    return _split_text(facts, about.made_for(facts.base))[0]


def results_text(results: Score | Path, about: Publication) -> str:
    """Return the README of results alone; see `results_files`."""
    facts = ResultsFacts.of(results)
    return _results_text(facts, about.made_for(facts.base))


def _demonstrations(dataset: Dataset) -> DatasetFacts:
    if dataset.kind != DEMONSTRATIONS:
        raise InvalidOptionError(
            f"{dataset.files.describe()} is a dataset of {dataset.kind}, not of {DEMONSTRATIONS}",
            "Units are published with the manifests that name them: give the split.",
        )
    return DatasetFacts(dataset)


def _demonstrations_text(facts: DatasetFacts, about: Publication) -> tuple[str, Film]:
    film = film_of_lesson(facts)
    values = {
        **_common(about, film, facts.dataset.cameras),
        "episodes": len(facts.records),
        "frames": facts.frames,
        "fps": FPS,
        "counts": facts.counts(),
        "goals": facts.goals(),
        "columns": _columns(columns_of(EpisodeRecord)),
        "split_name": facts.split_name,
        "first": str(facts.records[0].episode_id),
        "header": None,
        "other_conditions": [],
        "same_family": 0,
        "skipped": 0,
        "check": "sha256sum --check meta/SHA256SUMS",
        **_exactness(facts.inexact, len(facts.records), "episodes", facts.repositories),
        "provenance": provenance(about, dataset_rows(facts)),
        "details": sources({DEMONSTRATIONS: facts}),
        "limits": facts.limits,
    }
    head = front_matter(
        about,
        f"RoboMME-Interference demonstrations: {about.name}",
        facts.frames,
        [config(EPISODES, facts.split_name, RECORDS_PATH, default=True)],
        facts.repositories,
        ("LeRobot",),
    )
    return head + "\n" + _filled("demonstrations.md.j2", values), film


def _beyond(conditions: Iterable[str]) -> list[tuple[list[str], str]]:
    """Return the conditions beyond the paper's, kind by kind, with what they hold in words."""
    named = {one: parse_condition(one).kind for one in conditions if one not in DEFAULT_CONDITIONS}
    kinds = dict.fromkeys(named.values())
    return [([f"`{one}`" for one in named if named[one] == kind], kind.holds) for kind in kinds]


def _split_text(facts: SplitFacts, about: Publication) -> tuple[str, Film]:
    film = film_of_split(facts)
    split, units = facts.split, facts.units
    values = {
        **_common(about, film, split.cameras),
        "buffers": len(facts.manifests),
        "queries": len(facts.queries),
        "lessons": len(facts.queries),
        "units": sum(len(one.records) for one in units.values()),
        "conditions": split.conditions,
        "condition_table": facts.conditions(),
        "counts": facts.counts(),
        "goals": facts.demonstrations.goals(),
        "columns": _columns(columns_of(BufferManifest)),
        "questions": facts.questions,
        "first": str(facts.queries[0].episode_id),
        "split_name": facts.split_name,
        "units_split": facts.units_split,
        "header": split.header,
        "other_conditions": _beyond(split.conditions),
        "same_family": facts.same_family,
        "skipped": sum(one.skipped for one in units.values()),
        "check": f"robomme-interference verify {about.repo_id}@{about.tag}",
        **_exactness(facts.inexact, len(facts.manifests), "buffers", facts.repositories),
        "provenance": provenance(about, split_rows(facts, about)),
        "details": sources(facts.datasets),
        "limits": facts.limits,
    }
    head = front_matter(
        about,
        f"RoboMME-Interference buffers: {about.name}",
        sum(one.frames for one in units.values()),
        [
            config(BUFFERS, facts.split_name, BUFFERS_FILE, default=True),
            config(EPISODES, facts.units_split, RECORDS_PATH),
            *[config(QUESTIONS, facts.split_name, QUESTIONS_PATH)] * facts.questions,
        ],
        facts.repositories,
        ("LeRobot",),
    )
    return head + "\n" + _filled("split.md.j2", values), film


def _results_text(facts: ResultsFacts, about: Publication) -> str:
    values = {
        **_publication(about),
        **results_values(facts),
        "columns": _columns(facts.columns),
        "provenance": provenance(about, facts.provenance(about)),
        "details": {name: as_json(value) for name, value in facts.details.items()},
    }
    head = front_matter(
        about,
        f"RoboMME-Interference results: {about.name}",
        len(facts.score.rows),
        [facts.config],
        tags=("evaluation-results",),
    )
    return head + "\n" + _filled("results.md.j2", values)


def _filled(name: str, values: Mapping[str, Any]) -> str:
    filters: dict[str, Any] = {"code": code, "block": block, "table": table, "quoted": quoted}
    filters |= {"raw": Raw, "number": "{:,}".format}
    package = "robomme_interference_data.cards"
    text = fill(package, name, values, what="a card", finalize=escape, filters=filters)
    return text.rstrip() + "\n"


def _publication(about: Publication) -> dict[str, Any]:
    return {
        "about": about,
        "paper": citation.URL,
        "bibtex": citation.BIBTEX,
        "other": OTHER,
        "command": about.command,
    }


def _common(about: Publication, film: Film, cameras: Iterable[str]) -> dict[str, Any]:
    return {
        **_publication(about),
        "strip": film,
        "cameras": list(cameras),
        "unit_frames": UNIT_FRAMES,
        "unit_stride": UNIT_STRIDE,
        "unit_min": UNIT_MIN_RAW_FRAMES,
        "max_steps": MAX_STEPS,
        "released_limit": POSITION_LIMIT,
    }


def _exactness(
    inexact: int, of: int, what: str, repositories: Mapping[str, str | None]
) -> dict[str, Any]:
    return {
        "inexact": inexact,
        "exact_of": of,
        "exact_what": what,
        "lossy_source": LOSSY_SOURCE in repositories,
        "lossy_name": LOSSY_SOURCE,
    }


def _columns(columns: Iterable[Column]) -> Table:
    rows = []
    for column in columns:
        rows.append((code(column.name), column.words, escape(column.about)))
        for part in column.parts:
            rows.append((code(f"{column.name}.{part.name}"), part.words, escape(part.about)))
    return Table.make("columns", "Columns", "column type meaning", rows)
