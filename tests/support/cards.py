"""Cards of the golden buffer set and run, and the trees that are published of them."""

import shutil
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from support.buffer_sets import GOLDEN

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards.dataset_facts import buffer_set_facts, demonstrations_facts
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import card_files
from robomme_interference_data.cards.results import results_facts
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, MANIFESTS

CARDS = GOLDEN.parent / "cards"
"""Golden cards, made by `support/make_golden.py`."""

RUN = GOLDEN.parent / "run"

OF_DEMONSTRATIONS = Publication("robot-memory/tiny-demonstrations", "1.0.0")
OF_BUFFER_SET = Publication(
    "robot-memory/tiny-buffer_set",
    "1.2.0",
    "cc-by-4.0",
    f"{OF_DEMONSTRATIONS.repo_id}@{'0123456789' * 4}",
    "robomme-interference publish tiny --repo-id robot-memory/tiny-buffer_set",
)
OF_RESULTS = Publication(
    "robot-memory/tiny-results", "1.0.1", base=f"{OF_BUFFER_SET.repo_id}@{'abcdef0123' * 4}"
)


def cards() -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yield the golden cards by name."""
    buffer_set = load_buffer_set(GOLDEN)
    lessons = demonstrations_facts(buffer_set.datasets["demonstrations"])
    yield "demonstrations", card_files(lessons, OF_DEMONSTRATIONS)
    yield "buffer_set", card_files(buffer_set_facts(buffer_set), OF_BUFFER_SET)
    yield "results", card_files(results_facts(RUN), OF_RESULTS)


def without_version(file: bytes) -> str:
    """Return a card's file as text, the same whatever the version of this package."""
    own = f"robomme-interference-data {metadata.version('robomme-interference-data')}"
    return file.decode().replace(own, "robomme-interference-data X.Y.Z")


def published_buffer_set(root: Path, files: dict[str, bytes]) -> Path:
    """Make the tree of a buffer set's repository: the units at its root, manifests and a card."""
    shutil.copytree(GOLDEN / DISTRACTORS, root)
    shutil.copytree(GOLDEN / MANIFESTS, root / MANIFESTS)
    return _with_card(root, files)


def published_demonstrations(root: Path, files: dict[str, bytes]) -> Path:
    """Make the tree of the demonstrations' repository."""
    shutil.copytree(GOLDEN / DEMONSTRATIONS, root)
    return _with_card(root, files)


def published_run(root: Path, files: dict[str, bytes]) -> Path:
    """Make the tree of a results repository."""
    shutil.copytree(RUN, root)
    return _with_card(root, files)


def _with_card(root: Path, files: dict[str, bytes]) -> Path:
    for path, content in files.items():
        (root / path).write_bytes(content)
    return root
