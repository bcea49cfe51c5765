"""`croissant.json`: a card for machines, in the vocabulary of Croissant 1.0 and its RAI extension.

The core describes the files and the columns of the tables; of responsible AI, the fields that
dataset tracks ask for at least are filled in.
"""

import json
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote

import pyarrow as pa

from robomme_interference_data.constants import RECORDS_PATH, SUMS_PATH
from robomme_interference_data.data.questions import Question
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.storage.files import sha256_file

from . import citation
from .columns import Column, columns_of
from .contents import questions_of
from .facts import DatasetFacts, SplitFacts, kinds_of_sources
from .metadata import (
    BUFFERS,
    BUFFERS_FILE,
    EPISODES,
    QUESTIONS,
    ROLLOUTS,
)
from .publication import HUB, OTHER, Publication
from .responsible import origin, responsible
from .results import ResultsFacts

CONFORMS_TO = ("http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0")

_TERMS = "citeAs column conformsTo=dct equivalentProperty extract field fileProperty fileObject"
_TERMS += " fileSet format includes isLiveDataset jsonPath key md5 parentField path recordSet"
_TERMS += " references regex repeated replace samplingRate separator source subField transform"
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "prov": "http://www.w3.org/ns/prov#",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{
        term: f"{prefix or 'cr'}:{term}"
        for term, _, prefix in (one.partition("=") for one in _TERMS.split())
    },
}
"""What the terms of the file mean, as the specification has it."""

_TYPES = {
    pa.string(): "sc:Text",
    pa.int64(): "sc:Integer",
    pa.float64(): "sc:Float",
    pa.bool_(): "sc:Boolean",
    pa.binary(): "sc:ImageObject",
}
_FORMATS = {
    ".parquet": "application/x-parquet",
    ".json": "application/json",
    ".jsonl": "application/jsonlines",
    ".csv": "text/csv",
    ".mp4": "video/mp4",
    ".npy": "application/octet-stream",
}
_NO_SUM = "https://github.com/mlcommons/croissant/issues/80"
"""What stands for the SHA-256 of a repository, which has none."""

_REPOSITORY = "repository"


def as_bytes(data: Mapping[str, Any]) -> bytes:
    """Return the file: JSON that is safe inside a page's script element, too."""
    text = json.dumps(data, indent=2, ensure_ascii=False).replace("<", "\\u003c")
    return f"{text}\n".encode(errors="backslashreplace")


def of_demonstrations(facts: DatasetFacts, about: Publication) -> dict[str, Any]:
    """Return the description of demonstrations."""
    table = _episodes_file(facts, about)
    return {
        **_core(about, f"Demonstrations of RoboMME-Interference: {_size(facts)}."),
        **responsible(facts.limits, facts.families, facts.dataset.identity.simulators),
        **origin(
            about,
            facts.repositories,
            kinds_of_sources([facts]),
            "Recorded episodes were cut, encoded, decoded again and compared.",
        ),
        "distribution": [_repository(about), table, *_datafiles()],
        "recordSet": [_record_set(EPISODES, EpisodeRecord, table["@id"])],
    }


def of_split(facts: SplitFacts, about: Publication) -> dict[str, Any]:
    """Return the description of a split."""
    buffers = _file(about, BUFFERS_FILE, facts.split.header.rows)
    tables = [_episodes_file(one, about) for one in facts.units.values()][:1]
    pictures = questions_of(facts.split).items()
    questions = [_file(about, path, content.sha256) for path, content in pictures]
    families = dict.fromkeys(record.episode_id.family for record in facts.queries)
    told = (
        f"History buffers of RoboMME-Interference: {len(facts.manifests):,} buffers of "
        f"{len(facts.queries):,} query episodes under {', '.join(facts.split.conditions)}, and "
        "the distractor units that they hold."
    )
    return {
        **_core(about, told),
        **responsible(facts.limits, tuple(families), facts.simulators),
        **origin(
            about,
            facts.repositories,
            kinds_of_sources(facts.datasets.values()),
            f"The sessions of every buffer were drawn by SHA-256, rule version "
            f"{facts.split.header.rule_version}, seed {facts.split.header.seed}.",
        ),
        "distribution": [
            _repository(about),
            buffers,
            *tables,
            *questions,
            *_datafiles(),
            _file_set("manifest", "manifests/*.json"),
        ],
        "recordSet": [
            _record_set(BUFFERS, BufferManifest, buffers["@id"]),
            *(_record_set(EPISODES, EpisodeRecord, one["@id"]) for one in tables),
            *(_record_set(QUESTIONS, Question, one["@id"]) for one in questions),
        ],
    }


def of_results(facts: ResultsFacts, about: Publication) -> dict[str, Any]:
    """Return the description of results."""
    rows = _file(about, facts.rows_file.name, sha256_file(facts.rows_file))
    told = (
        f"Rollouts of {', '.join(facts.systems)} on RoboMME-Interference: "
        f"{len(facts.score.rows):,} rows."
    )
    simulators = tuple(facts.score.outcomes)
    families = tuple(facts.score.rows.names("family"))
    return {
        **_core(about, told),
        **responsible(facts.limits, families, simulators),
        **origin(about, {}, [], "A policy was rolled out in a simulator, a row an episode."),
        "distribution": [_repository(about), rows],
        "recordSet": [_record_set(ROLLOUTS, facts.columns, rows["@id"])],
    }


def _core(about: Publication, description: str) -> dict[str, Any]:
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": list(CONFORMS_TO),
        "name": about.name,
        "alternateName": about.repo_id,
        "description": description,
        "url": about.url,
        "version": about.version,
        "license": _license(about),
        "creator": {
            "@type": "sc:Organization",
            "name": about.namespace,
            "url": f"{HUB}/{about.namespace}",
        },
        "citeAs": citation.BIBTEX,
        "keywords": ["robotics", "robot memory", "RoboMME-Interference", "LeRobot"],
        "isLiveDataset": False,
    }


def _license(about: Publication) -> str:
    if about.license == OTHER:
        return f"{about.url}#licence"
    return f"https://choosealicense.com/licenses/{about.license}/"


# --- files and columns -------------------------------------------------------------------------


def _repository(about: Publication) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": _REPOSITORY,
        "name": _REPOSITORY,
        "description": "The repository on the Hub, at the tag of this version.",
        "contentUrl": f"{about.url}/tree/{about.tag}",
        "encodingFormat": "git+https",
        "sha256": _NO_SUM,
    }


def _file(about: Publication, path: str, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": path,
        "name": path,
        "contentUrl": f"{about.url}/resolve/{about.tag}/{quote(path)}",
        "encodingFormat": _format(path),
        "sha256": sha256,
    }


def _file_set(name: str, includes: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "containedIn": {"@id": _REPOSITORY},
        "encodingFormat": _format(includes),
        "includes": includes,
    }


def _datafiles() -> list[dict[str, Any]]:
    return [
        _file_set("frames", "data/*/*.parquet"),
        _file_set("videos", "videos/*/*/*.mp4"),
    ]


def _format(path: str) -> str:
    suffix = path[path.rfind(".") :]
    return _FORMATS.get(suffix.lower(), "application/octet-stream")


def _episodes_file(facts: DatasetFacts, about: Publication) -> dict[str, Any]:
    """Return the table of episodes, which is one file."""
    digest = facts.dataset.sums().get(RECORDS_PATH)
    if digest is None:
        where = facts.dataset.files.describe()
        raise FormatError.damaged(where, f"{RECORDS_PATH} is not in {SUMS_PATH}")
    return _file(about, RECORDS_PATH, digest)


def _size(facts: DatasetFacts) -> str:
    return (
        f"{len(facts.records):,} query episodes, {facts.frames:,} frames, families "
        f"{', '.join(facts.families)}"
    )


def _record_set(name: str, record: Any, file: str) -> dict[str, Any]:
    columns = columns_of(record) if isinstance(record, type) else record
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "field": [_field(name, column, file) for column in columns],
    }


def _field(parent: str, column: Column, file: str) -> dict[str, Any]:
    source = {"fileObject": {"@id": file}, "extract": {"column": column.name}}
    found: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"{parent}/{column.name}",
        "name": column.name,
        "description": column.about or column.name,
    }
    if column.repeated:
        found["repeated"] = True
    if not column.parts:
        return {**found, "dataType": _TYPES[column.item], "source": source}
    found["subField"] = [
        {
            "@type": "cr:Field",
            "@id": f"{parent}/{column.name}/{part.name}",
            "name": part.name,
            "description": part.about or part.name,
            "dataType": _TYPES[part.item],
            "source": {**source, "transform": {"jsonPath": part.name}},
        }
        for part in column.parts
    ]
    return found
