"""The front matter of cards: what the Hub reads of them, as YAML."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from robomme_interference_data.constants import MANIFEST_ROWS, MANIFESTS

from .publication import Publication

BUFFERS, EPISODES, QUESTIONS, ROLLOUTS = "buffers", "episodes", "questions", "rollouts"
"""Names under which `datasets.load_dataset` gives the tables."""

BUFFERS_FILE = f"{MANIFESTS}/{MANIFEST_ROWS}"

_TAGS = ("robotics", "robot-memory", "RoboMME", "RoboMME-Interference")
_SIZES = (
    (10**3, "n<1K"),
    (10**4, "1K<n<10K"),
    (10**5, "10K<n<100K"),
    (10**6, "100K<n<1M"),
    (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"),
    (10**9, "100M<n<1B"),
    (10**10, "1B<n<10B"),
    (10**11, "10B<n<100B"),
    (10**12, "100B<n<1T"),
)


def size_category(count: int) -> str:
    """Return the Hub's category of a number of examples."""
    return next((name for most, name in _SIZES if count < most), "n>1T")


def config(name: str, split: str, *paths: str, default: bool = False) -> dict[str, Any]:
    """Return a table as `load_dataset` finds it.

    Args:
        name: Its name.
        split: Name that its rows load under, such as `test`.
        paths: Its files, or patterns of them, in the repository.
        default: Whether it is the one that loads without a name.
    """
    files = [{"split": split, "path": paths[0] if len(paths) == 1 else list(paths)}]
    found: dict[str, Any] = {"config_name": name, "data_files": files}
    return {**found, "default": True} if default else found


def front_matter(
    about: Publication,
    title: str,
    examples: int,
    configs: Sequence[Mapping[str, Any]],
    sources: Iterable[str] = (),
    tags: Iterable[str] = (),
) -> str:
    """Return the front matter of a card, `---` lines included.

    Args:
        about: What is published.
        title: Name for readers.
        examples: How many there are: stored frames, or rollouts.
        configs: Its tables, see `config`.
        sources: Repositories on the Hub that it was made from.
        tags: More than every card has.
    """
    from huggingface_hub import DatasetCardData

    made_from = sorted({*sources, *filter(None, [about.base_repo])})
    data = DatasetCardData(
        pretty_name=title,
        license=about.license,
        task_categories=["robotics"],
        tags=[*tags, *_TAGS],
        size_categories=[size_category(examples)],
        source_datasets=made_from or ["original"],
        configs=[dict(one) for one in configs],
    )
    order = ["pretty_name", "license", "task_categories", "tags", "size_categories"]
    text = data.to_yaml(line_break="\n", original_order=[*order, "source_datasets", "configs"])
    return f"---\n{text}\n---\n"
