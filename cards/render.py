"""Cards as files: what a repository says of itself, all of it from data.

The same data, publication and version of this package (and, for the picture, of matplotlib) give
the same bytes.
"""

import json
from importlib import metadata
from typing import Any

from robomme_interference_data.constants import (
    FORMAT_VERSION,
    FPS,
    MAX_STEPS,
    POSITION_LIMIT,
    UNIT_FRAMES,
    UNIT_MIN_RAW_FRAMES,
    UNIT_STRIDE,
)
from robomme_interference_data.viz.tables import Table
from robomme_interference_data.viz.templates import fill

from .croissant import BIBTEX, PAPER, croissant
from .facts import Facts
from .markdown import Raw, block, code, escape, quoted, table
from .publication import OTHER, Publication
from .tables import column_table

README, CROISSANT = "README.md", "croissant.json"

_TAGS = ("robotics", "robot-memory", "RoboMME", "RoboMME-Interference")
_PROTOCOL = {
    "fps": FPS,
    "unit_frames": UNIT_FRAMES,
    "unit_stride": UNIT_STRIDE,
    "unit_min": UNIT_MIN_RAW_FRAMES,
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


def card_files(facts: Facts, about: Publication) -> dict[str, bytes]:
    """Return a card: its files by their path in the repository.

    Args:
        facts: What there is to say, such as `buffer_set_facts(buffer set)`.
        about: As what it is published; where `base` is not given, the data names it.
    """
    about = about.made_for(facts.base)
    text, data = card_text(facts, about), croissant(facts, about)
    return {README: text.encode(), **facts.pictures(), CROISSANT: data}


def is_card(path: str) -> bool:
    """Tell whether a file of a repository is one of its card."""
    return path.startswith("README") or path == CROISSANT


def card_text(facts: Facts, about: Publication) -> str:
    """Return the README of a card alone, without drawing; see `card_files`."""
    about = about.made_for(facts.base)
    rows = (
        ("repository", code(about.repo_id)),
        ("version", code(about.tag)),
        *facts.provenance(about),
        ("made with", code(f"robomme-interference-data {_package_version()}")),
        ("version of the format", code(FORMAT_VERSION)),
    )
    values = {
        **_PROTOCOL,
        **facts.values,
        "about": about,
        "repositories": facts.repositories,
        "paper": PAPER,
        "bibtex": BIBTEX,
        "other": OTHER,
        "frames": facts.examples,
        "split_name": facts.tables[0].split,
        "columns": column_table(facts.tables[0].record),
        "provenance": Table.make("provenance", "Provenance", "what value", rows),
        "details": {title: _readable_json(value) for title, value in facts.details.items()},
        "limits": facts.limits,
    }
    text = fill(
        "robomme_interference_data.cards",
        f"{facts.kind}.md.j2",
        values,
        what="a card",
        finalize=escape,
        filters=_FILTERS,
    )
    return f"{front_matter(facts, about)}\n{text.rstrip()}\n"


def front_matter(facts: Facts, about: Publication) -> str:
    """Return what the Hub reads of a card: YAML, `---` lines included."""
    from huggingface_hub import DatasetCardData

    made_from = sorted({*facts.repositories, *filter(None, [about.base_repo])})
    configs: list[dict[str, Any]] = [
        {"config_name": one.name, "data_files": [{"split": one.split, "path": one.path}]}
        for one in facts.tables
    ]
    configs[0]["default"] = True
    data = DatasetCardData(
        pretty_name=f"{facts.title}: {about.name}",
        license=about.license,
        task_categories=["robotics"],
        tags=[*facts.tags, *_TAGS],
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


def _readable_json(value: Any) -> str:
    return json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False)


def _package_version() -> str:
    return metadata.version("robomme-interference-data")
