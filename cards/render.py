"""The files of a card: `README.md` and pictures.

Equal data, publication and version of this package (and, for pictures, of matplotlib) give equal
bytes.
"""

import json
from importlib import metadata
from typing import Any

from robomme_interference_data.constants import (
    FORMAT_VERSION,
    MAX_STEPS,
    PAPER_UNIT,
    POSITION_LIMIT,
)
from robomme_interference_data.package import DISTRIBUTION, install_source
from robomme_interference_data.viz.tables import Table
from robomme_interference_data.viz.templates import fill

from .facts import Facts
from .markdown import Raw, block, code, escape, quoted, table
from .publication import OTHER, Publication
from .tables import column_table

README = "README.md"

PAPER = "https://arxiv.org/abs/2606.22338"
BIBTEX = f"""@article{{rathi2026robommeinterference,
  title  = {{RoboMME-Interference: Benchmarking Robot Memory Under Interference}},
  author = {{Rathi, Soumil}},
  year   = {{2026}},
  note   = {{arXiv:2606.22338}},
  url    = {{{PAPER}}}
}}"""
"""The paper; `CITATION.cff` of the project says the same."""

_TAGS = ("robotics", "robot-memory", "RoboMME-Interference")
_PROTOCOL = {
    "unit": PAPER_UNIT,
    "paper_unit": PAPER_UNIT,
    "max_steps": MAX_STEPS,
    "released_limit": POSITION_LIMIT,
}
_FILTERS = {
    "code": code,
    "block": block,
    "table": table,
    "quoted": quoted,
    "raw": Raw,
    "number": "{:,}".format,
}


def card_files(facts: Facts, publication: Publication) -> dict[str, bytes]:
    """Return the files of a card, by their path in the repository.

    Args:
        facts: What the card states, such as `buffer_set_facts(buffer_set)`.
        publication: The version; without a `base` it gets the one that the data names.
    """
    publication = publication.made_for(facts.base)
    return {README: card_text(facts, publication).encode(), **facts.pictures()}


def is_card(path: str) -> bool:
    """Return whether a file of a repository belongs to its card."""
    return path.startswith("README")


def card_text(facts: Facts, publication: Publication) -> str:
    """Return the README of a card, without drawing pictures; see `card_files`."""
    publication = publication.made_for(facts.base)
    base = code(publication.base) if publication.base else "none"
    base_rows = [(f"published {facts.base_kind}", base)] if facts.base_kind else []
    rows = (
        ("repository", code(publication.repo_id)),
        ("version", code(publication.tag)),
        *base_rows,
        *facts.provenance,
        ("made with", code(f"{DISTRIBUTION} {metadata.version(DISTRIBUTION)}")),
        ("version of the format", code(FORMAT_VERSION)),
    )
    values = {
        **_PROTOCOL,
        **facts.values,
        "publication": publication,
        "repositories": facts.repositories,
        "paper": PAPER,
        "bibtex": BIBTEX,
        "install": f"pip install {install_source()}",
        "other": OTHER,
        "frames": facts.examples,
        "split_name": facts.tables[0].split,
        "columns": column_table(facts.tables[0].record),
        "provenance": Table("provenance", "Provenance", {"what": "text", "value": "text"}, rows),
        "details": {
            title: json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False)
            for title, value in facts.details.items()
        },
        "limits": facts.limits,
        "simulated": facts.simulated,
    }
    text = fill(
        "robomme_interference_data.cards",
        f"{facts.kind}.md.j2",
        values,
        what="a card",
        finalize=escape,
        filters=_FILTERS,
    )
    return f"{front_matter(facts, publication)}\n{text.rstrip()}\n"


def front_matter(facts: Facts, publication: Publication) -> str:
    """Return the part of a card that the Hub reads: YAML between lines of `---`."""
    from huggingface_hub import DatasetCardData

    base = [publication.base.split("@")[0]] if publication.base else []
    made_from = sorted({*facts.repositories, *base})
    configs: list[dict[str, Any]] = [
        {"config_name": table.name, "data_files": [{"split": table.split, "path": table.path}]}
        for table in facts.tables
    ]
    configs[0]["default"] = True
    tags = [*facts.tags, *_TAGS]
    if "robomme" in facts.simulators:
        tags.append("RoboMME")
    data = DatasetCardData(
        pretty_name=f"{facts.title}: {publication.name}",
        license=publication.license,
        task_categories=["robotics"],
        tags=tags,
        size_categories=[size_category(facts.examples)],
        source_datasets=made_from or ["original"],
        configs=configs,
    )
    order = ["pretty_name", "license", "task_categories", "tags", "size_categories"]
    text = data.to_yaml(line_break="\n", original_order=[*order, "source_datasets", "configs"])
    return f"---\n{text}\n---\n"


def size_category(count: int) -> str:
    """Return the Hub's category of a number of examples, such as `1K<n<10K`."""
    names = [f"{step}{unit}" for unit in "KMB" for step in (1, 10, 100)] + ["1T"]
    power = len(str(count)) - 4
    if power < 0:
        return "n<1K"
    return f"{names[power]}<n<{names[power + 1]}" if power + 1 < len(names) else "n>1T"
