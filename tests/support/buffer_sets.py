"""The tiny golden buffer set, copies of it, and what its frames must be."""

import shutil
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.frame_selection import select_frames
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.build_dataset.sources import Frame, Source
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.constants import SUMS_PATH
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry
from robomme_interference_data.storage.files import LocalFiles, format_sums, sha256_file

GOLDEN = Path(__file__).parents[1] / "golden" / "buffer_set"
"""Three test queries and the train units of nine families, 32 × 32 pixels, made by
`support/make_golden.py` from the source `sample`."""

QUERIES = ("VideoRepick/test/0", "MoveCube/test/0", "PatternLock/test/0")
CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
LESSON = 48
UNITS = 17


def copy_buffer_set(folder: Path, buffer_set: Path = GOLDEN) -> Path:
    """Copy a buffer set, to be damaged or extended."""
    return Path(shutil.copytree(buffer_set, folder))


def build(root: Path, kind: str, source: Source, **episodes: Any) -> None:
    """Build a dataset of a buffer set from some episodes of a source."""
    plan = DatasetPlan(kind, (source,), choose_episodes((source,), **episodes))
    build_dataset(plan, root / kind, Serial(), WorkProgress(quiet=True))


def plan_again(root: Path, conditions: Iterable[str] = CONDITIONS, **options: Any) -> None:
    """Plan the buffers of a buffer set and replace its manifests."""
    for _ in write_manifests(plan_manifests(datasets_in(root), tuple(conditions), **options), root):
        pass


def violations(root: Path, *, decode: bool = True) -> list[str]:
    """Return what `verify` finds in a buffer set."""
    found = verify_buffer_set(load_buffer_set(root), decode=decode)
    return [f"{one.where}: {one.what}" for one in found]


def contents(root: Path) -> dict[str, bytes]:
    """Return all files under a folder."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def dataset(root: Path, name: str) -> Dataset:
    """Open a dataset of a buffer set."""
    return Dataset(LocalFiles(root / name))


@cache
def _stored(kind: str, episode: EpisodeId) -> tuple[Frame, ...]:
    source = SampleSource(size=32)
    [listed] = [one for one in source.episodes() if one.id == episode]
    return tuple(select_frames(kind, source.read(listed, None)))


def stored_frames(kind: str, episode: EpisodeId, camera: str) -> NDArray[np.uint8]:
    """Return what a dataset must store of an episode, from the source itself."""
    return np.stack([frame.images[camera] for frame in _stored(kind, episode)])


def stored_states(kind: str, episode: EpisodeId) -> NDArray[np.float32]:
    """Return the states that go with `stored_frames`."""
    return np.stack([frame.state for frame in _stored(kind, episode)])


def expected_frames(entries: tuple[SessionEntry, ...], camera: str) -> NDArray[np.uint8]:
    """Return the frames that sessions must show, one after the other."""
    parts = [np.empty((0, 32, 32, 3), np.uint8)]
    for entry in entries:
        frames = stored_frames(entry.dataset, entry.source, camera)[entry.start : entry.stop]
        parts.append(np.repeat(frames, entry.repeat, axis=0))
    return np.concatenate(parts)


def expected_states(entries: tuple[SessionEntry, ...]) -> NDArray[np.float32]:
    """Return the states that sessions must show."""
    parts = [np.empty((0, 8), np.float32)]
    for entry in entries:
        states = stored_states(entry.dataset, entry.source)[entry.start : entry.stop]
        parts.append(np.repeat(states, entry.repeat, axis=0))
    return np.concatenate(parts)


def with_sessions(manifest: BufferManifest, *entries: SessionEntry) -> BufferManifest:
    """Return a manifest that holds other sessions, in any order."""
    known = {name: getattr(manifest, name) for name in BufferManifest.__dataclass_fields__}
    frames = sum(entry.num_frames for entry in entries)
    return BufferManifest(**{**known, "sessions": entries, "history_frames": frames})


def renew_sums(root: Path) -> None:
    """Recompute the SHA-256 of a dataset's files, as whoever changed them might."""
    listed = [line.split("  ", 1)[1] for line in (root / SUMS_PATH).read_text().splitlines()]
    existing = [path for path in listed if (root / path).is_file()]
    before = sha256_file(root / SUMS_PATH)
    (root / SUMS_PATH).write_text(format_sums(root, existing))
    identity = root / "meta" / "interference.json"
    identity.write_text(identity.read_text().replace(before, sha256_file(root / SUMS_PATH)))
