"""Small real data for tests: a recorded sample, and a split built from it through lerobot."""

import atexit
import shutil
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset.build import Filters, Settings, build_dataset
from robomme_interference_data.build_dataset.encode import get_codec
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.sample import write_sample
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.progress import BuildProgress

FAMILIES = ("VideoRepick", "VideoUnmask", "MoveCube", "PatternLock")
K = (0, 1, 3)
CAMERAS = ("observation.images.front", "observation.images.wrist")


def build(
    kind: str,
    source: Path,
    out: Path,
    *,
    split: str | None = None,
    codec: str = "av1-lossless",
    cameras: tuple[str, ...] | None = None,
    workers: int = 1,
) -> Dataset:
    """Build one dataset from a folder in the frames layout."""
    build_dataset(
        kind,
        [open_source(f"frames:{source}")],
        out,
        Filters(split=split),
        Settings(codec=get_codec(codec), cameras=cameras, workers=workers),
        BuildProgress(quiet=True),
    )
    return Dataset(LocalFiles(out))


def build_split(source: Path, out: Path, k: Sequence[int] = K, seed: int = 0) -> Path:
    """Build demonstrations of the test episodes, units of the train episodes, and manifests."""
    queries = build("demonstrations", source, out / "demonstrations", split="test")
    units = build("distractors", source, out / "distractors", split="train")
    for _ in write_manifests(plan_manifests(queries, units, k, seed), out / "manifests"):
        pass
    return out


@cache
def sample() -> Path:
    """A sample of four families at 64 × 64, made once per process; treat it as read-only.

    Two train and two test episodes a family; VideoRepick/train/1 is too short for a unit, so the
    pool has 7 units. Lessons have 20 (index 0) and 36 (index 1) frames.
    """
    folder = temporary() / "sample"
    for _ in write_sample(folder, families=FAMILIES, train=2, test=2, size=64, demonstration=20):
        pass
    return folder


@cache
def split() -> Path:
    """A split of the sample (8 queries, 7 units, k 0, 1, 3), made once; treat it as read-only."""
    return build_split(sample(), temporary() / "split")


def copy_of_split(folder: Path) -> Path:
    """A copy of the split, to be damaged."""
    shutil.copytree(split(), folder)
    return folder


@cache
def temporary() -> Path:
    """A folder that goes when the process ends."""
    folder = Path(tempfile.mkdtemp(prefix="interference-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
