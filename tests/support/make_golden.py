"""Make the golden buffer sets anew: `python tests/support/make_golden.py tests/golden`."""

import shutil
import sys
from pathlib import Path

from support.tabletop import make_tabletop

from robomme_interference_data.build_dataset.build import build_dataset
from robomme_interference_data.build_dataset.config import BuildPlan, list_episodes
from robomme_interference_data.build_dataset.manifests import (
    in_folder,
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.runtime.progress import WorkProgress

FAMILIES = ("VideoRepick", "MoveCube", "PatternLock")


def make(root: Path) -> None:
    """Build the buffer set of the source `sample`."""
    source = (SampleSource(size=32),)
    queries = list_episodes(source, families=FAMILIES, split="test")
    units = list_episodes(source, split="train", numbers=(0, 1))
    with WorkProgress(unit="episodes", quiet=True) as progress:
        for kind, tasks in (("demonstrations", queries), ("distractors", units)):
            build_dataset(BuildPlan(kind, source, tasks), root / kind, Serial(), progress)
    for _ in write_manifests(plan_manifests(in_folder(root)), root):
        pass


if __name__ == "__main__":
    for name, build in (("buffer_set", make), ("tabletop", make_tabletop)):
        golden = Path(sys.argv[1]) / name
        shutil.rmtree(golden, ignore_errors=True)  # a build goes on with what is there
        build(golden)
