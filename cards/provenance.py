"""Where what is published comes from: repositories, commits, hashes and versions."""

import json
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

from robomme_interference_data.constants import FORMAT_VERSION
from robomme_interference_data.viz.tables import Table

from .facts import DatasetFacts, SplitFacts
from .markdown import code, escape
from .publication import Publication


def provenance(about: Publication, rows: Iterable[tuple[str, Any]]) -> Table:
    """Return where something comes from, as a table; texts of `rows` are Markdown already."""
    own = (
        ("repository", code(about.repo_id)),
        ("version", code(about.tag)),
        *rows,
        ("made with", code(f"robomme-interference-data {_package_version()}")),
        ("version of the format", code(FORMAT_VERSION)),
    )
    return Table.make("provenance", "Provenance", "what value", own)


def _package_version() -> str:
    return metadata.version("robomme-interference-data")


def dataset_rows(facts: DatasetFacts, name: str = "") -> list[tuple[str, Any]]:
    """Return the rows of a dataset; `name` tells it from the others of a split."""
    identity, of = facts.dataset.identity, f" of the {escape(name)}" if name else ""
    rows = [
        (f"revision of the content{of}", code(identity.revision)),
        (f"SHA-256 of `meta/interference.json`{of}", code(facts.identity_sha256)),
        (f"codec{of}", code(identity.codec)),
    ]
    for repo, commit in facts.repositories.items():
        rows.append((f"source{of}", code(f"{repo}@{commit}" if commit else repo)))
    return rows


def split_rows(facts: SplitFacts, about: Publication) -> list[tuple[str, Any]]:
    """Return the rows of a split and of its datasets."""
    split = facts.split
    rows: list[tuple[str, Any]] = [
        ("demonstrations", code(about.base) if about.base else "not published"),
        ("revision of the split", code(split.revision)),
        ("SHA-256 of `manifests/buffers.parquet`", code(split.header.rows)),
    ]
    for name, one in facts.datasets.items():
        rows += dataset_rows(one, name)
    return [*rows, ("version of the draw", code(split.header.rule_version))]


def sources(facts: Mapping[str, DatasetFacts]) -> dict[str, str]:
    """Return what the sources of datasets say of themselves, as JSON, by what it is."""
    found = {name: list(one.dataset.identity.sources) for name, one in facts.items()}
    return {f"Sources of the {name}": as_json(told) for name, told in found.items() if told}


def as_json(value: Any) -> str:
    """Return a value as JSON to be read."""
    return json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False)
