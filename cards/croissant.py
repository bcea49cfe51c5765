"""`croissant.json`: a card for machines, in the vocabulary of Croissant 1.0 and its RAI extension.

`templates/croissant.json.j2` holds its text. The core describes the files and the columns of the
tables; of responsible AI, the fields that dataset tracks ask for at least are filled in.
"""

import json
from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

import pyarrow as pa

from robomme_interference_data.viz.templates import fill

from .facts import Facts
from .publication import HUB, OTHER, Publication
from .tables import CardColumn, columns_of

PAPER = "https://robotmemorybench.com"
BIBTEX = f"""@article{{rathi2026robommeinterference,
  title  = {{RoboMME-Interference: Benchmarking Robot Memory Under Interference}},
  author = {{Rathi, Soumil}},
  year   = {{2026}},
  month  = {{8}},
  url    = {{{PAPER}}}
}}"""
"""The paper; `CITATION.cff` of the project says the same."""

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
}


def croissant(facts: Facts, about: Publication) -> bytes:
    """Return the file: JSON that is safe inside a page's script element, too."""
    values = {
        "about": about,
        "facts": facts,
        "hub": HUB,
        "bibtex": BIBTEX,
        "license": f"{about.url}#licence"
        if about.license == OTHER
        else f"https://choosealicense.com/licenses/{about.license}/",
        "sources": _sources(facts, about),
        "files": [_file(about, one.path, one.sha256) for one in facts.tables],
        "file_sets": [_file_set(name, paths) for name, paths in facts.file_sets.items()],
        "record_sets": [
            {
                "@type": "cr:RecordSet",
                "@id": one.name,
                "name": one.name,
                "field": _fields(one.name, columns_of(one.record), one.path),
            }
            for one in facts.tables
        ],
    }
    # The filter of jinja2 sorts keys.
    package, filters = "robomme_interference_data.cards", {"tojson": json.dumps}
    text = fill(package, "croissant.json.j2", values, what="croissant.json", filters=filters)
    return as_bytes(json.loads(text))


def as_bytes(data: Any) -> bytes:
    """Return JSON as the file has it."""
    text = json.dumps(data, indent=2, ensure_ascii=False).replace("<", "\\u003c")
    return f"{text}\n".encode(errors="backslashreplace")


def _sources(facts: Facts, about: Publication) -> list[dict[str, str]]:
    """Return what the data was made from."""
    repositories = dict(facts.repositories)
    if about.base_repo:
        repositories[about.base_repo] = about.base_commit
    found = [
        {
            "@type": "sc:Dataset",
            "name": repo,
            "url": f"{HUB}/datasets/{repo}" + (f"/tree/{commit}" if commit else ""),
        }
        for repo, commit in sorted(repositories.items())
    ]
    kinds = (f"recorded episodes, read as {kind}" for kind in facts.source_kinds)
    return [*found, *({"@type": "sc:Dataset", "name": name} for name in kinds)]


def _file(about: Publication, path: str, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": path,
        "name": path,
        "contentUrl": f"{about.url}/resolve/{about.tag}/{quote(path)}",
        "encodingFormat": _format(path),
        "sha256": sha256,
    }


def _file_set(name: str, paths: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "containedIn": {"@id": "repository"},
        "encodingFormat": _format(paths),
        "includes": paths,
    }


def _format(path: str) -> str:
    return _FORMATS.get(PurePosixPath(path).suffix.lower(), "application/octet-stream")


def _fields(parent: str, columns: Iterable[CardColumn], file: str) -> list[dict[str, Any]]:
    """Return what columns hold; a part of a record is taken from the JSON of its column."""
    found = []
    for column in columns:
        source = {"fileObject": {"@id": file}, "extract": {"column": column.name}}
        one = _field(parent, column)
        if column.repeated:
            one["repeated"] = True
        if column.parts:
            one["subField"] = [
                {
                    **_field(one["@id"], part),
                    "dataType": _TYPES[part.item],
                    "source": {**source, "transform": {"jsonPath": part.name}},
                }
                for part in column.parts
            ]
        else:
            one |= {"dataType": _TYPES[column.item], "source": source}
        found.append(one)
    return found


def _field(parent: str, column: CardColumn) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{parent}/{column.name}",
        "name": column.name,
        "description": column.about,
    }
