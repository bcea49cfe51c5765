"""Make the golden buffer sets and cards: `python tests/support/make_golden.py tests/golden`."""

import shutil
import sys
from pathlib import Path

from support.boards import make_golden_leaderboard
from support.buffer_sets import build, plan_again
from support.cards import cards, without_version
from support.tabletop import make_tabletop

from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.cards.render import README

FAMILIES = ("VideoRepick", "MoveCube", "PatternLock")


def make_sample(root: Path) -> None:
    """Build the buffer set of the source `sample`."""
    source = SampleSource(size=32)
    build(root, "demonstrations", source, families=FAMILIES, split="test")
    build(root, "distractors", source, split="train", numbers=(0, 1))
    plan_again(root)


def make_cards(folder: Path) -> None:
    """Write the text of the cards, without the version of this package."""
    for name, files in cards():
        text = without_version(files[README])
        (folder / f"{name}.md").write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    for name, make in (
        ("buffer_set", make_sample),
        ("tabletop", make_tabletop),
        ("cards", make_cards),
        ("leaderboard", make_golden_leaderboard),
    ):
        golden = Path(sys.argv[1]) / name
        shutil.rmtree(golden, ignore_errors=True)  # a build would resume
        golden.mkdir(parents=True)
        make(golden)
