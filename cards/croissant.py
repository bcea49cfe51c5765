"""`croissant.json`: a card for machines, in the vocabulary of Croissant 1.0 and its RAI extension.

`templates/croissant.json.j2` holds its text. The core describes the files and the columns of the
tables; of responsible AI, the fields that dataset tracks ask for at least are filled in.
"""

import json
from pathlib import PurePosixPath
from typing import Any

import pyarrow as pa

from robomme_interference_data.viz.templates import fill

from .facts import Facts
from .publication import HUB, OTHER, Publication
from .tables import columns_of

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
    repositories = dict(facts.repositories)
    if about.base_repo:
        repositories[about.base_repo] = about.base_commit
    values = {
        "about": about,
        "facts": facts,
        "hub": HUB,
        "other": OTHER,
        "bibtex": BIBTEX,
        "repositories": sorted(repositories.items()),
        "types": _TYPES,
        "columns": columns_of,
    }
    filters = {"tojson": json.dumps, "format": _format}  # that of jinja2 sorts keys
    package = "robomme_interference_data.cards"
    text = fill(package, "croissant.json.j2", values, what="croissant.json", filters=filters)
    return as_bytes(json.loads(text))


def as_bytes(data: Any) -> bytes:
    """Return JSON as the file has it."""
    text = json.dumps(data, indent=2, ensure_ascii=False).replace("<", "\\u003c")
    return f"{text}\n".encode(errors="backslashreplace")


def _format(path: str) -> str:
    return _FORMATS.get(PurePosixPath(path).suffix.lower(), "application/octet-stream")
