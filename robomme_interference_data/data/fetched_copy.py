"""What a copy of a published buffer set holds: `fetch --to` may have copied a part of it."""

import shlex
from collections.abc import Mapping
from pathlib import Path

from robomme_interference_data.constants import (
    FETCH_RECORD,
    INFO_PATH,
    MANIFEST_PATH,
    QUESTIONS_PATH,
)
from robomme_interference_data.errors import InvalidOptionError, MissingFileError
from robomme_interference_data.schema.manifest import BufferManifest, FetchRecord, ManifestHeader
from robomme_interference_data.storage.files import Files, LocalFiles
from robomme_interference_data.storage.text import read_header

from .dataset import Dataset


def read_fetch_record(root: Path) -> FetchRecord:
    """Return what a copy records of the fetch that made it.

    Raises:
        FormatError: The record is damaged, or of an unknown version.
    """
    return read_header(root / FETCH_RECORD, FetchRecord)


def open_copy(root: Path) -> "FetchedCopy":
    """Return the copy in a folder with a record of the fetch; see `read_fetch_record`."""
    return FetchedCopy(root, read_fetch_record(root))


def fetch_command(root: Path, record: FetchRecord) -> str:
    """Return the command that adds all that a copy lacks."""
    return f"fetch {record.location} --to {shlex.quote(str(root))}"


def earlier_files(to: Path, location: str, header: Path) -> tuple[str, ...]:
    """Return the files of an earlier copy of a buffer set; check that a folder holds nothing else.

    `location` and `header`, the file of its manifests' header, identify the buffer set.
    """
    if not to.exists() or (to.is_dir() and not any(to.iterdir())):
        return ()
    record = read_fetch_record(to) if (to / FETCH_RECORD).is_file() else None
    if record is None:
        raise InvalidOptionError(
            f"{to} exists, and is no copy of a buffer set",
            "Give another folder: fetch NAMESPACE/NAME --to FOLDER.",
        )
    existing = to / MANIFEST_PATH
    if existing.is_file():
        # By content: a later commit that changes only the card has the same header.
        is_same = existing.read_bytes() == header.read_bytes()
    else:  # an interrupted copy: the header is moved last
        is_same = record.location == location
    if not is_same:
        raise InvalidOptionError(
            f"{to} is a copy of {record.location}",
            "Give another folder, or add to this copy:",
            fetch_command(to, record),
        )
    return record.files


class FetchedCopy:
    """The folder of a copy, and what its record lists.

    Attributes:
        root: The folder.
        record: What `fetch` recorded.
    """

    def __init__(self, root: Path, record: FetchRecord):
        self.root, self.record = root, record
        self._files = frozenset(record.files)
        self._cameras: dict[str, dict[int, frozenset[str]]] = {}

    @property
    def refetch(self) -> str:
        """The command that adds all that it lacks."""
        return fetch_command(self.root, self.record)

    def not_fetched(self, what: str, options: str = "") -> MissingFileError:
        """Return the error about what a partial copy lacks.

        Args:
            what: What it lacks, in the plural.
            options: Options with which `fetch` adds it; empty for everything.
        """
        return MissingFileError(
            f"{what} are not in {self.root}, a copy of a part of {self.record.location}",
            "Fetch them too.",
            f"{self.refetch} {options}".strip(),
        )

    def has_dataset(self, files: Files) -> bool:
        """Whether the metadata of a dataset is here, or on the Hub, from which it is read."""
        return not isinstance(files, LocalFiles) or self.lists(files.root, INFO_PATH)

    def lists(self, folder: Path, path: str) -> bool:
        """Whether the record lists a file in `folder`, if that is in the copy."""
        if not folder.is_relative_to(self.root):  # of a dataset that is read from the Hub
            return True
        return (folder.relative_to(self.root) / path).as_posix() in self._files

    def holds(self, dataset: Dataset, episode_index: int) -> bool:
        """Whether an episode's vectors and at least one of its videos are here."""
        return episode_index in self._episodes(dataset)

    def holds_all(self, dataset: Dataset, episode_index: int) -> bool:
        """Whether an episode's vectors and all of its videos are here."""
        return self._episodes(dataset).get(episode_index) == frozenset(dataset.cameras)

    def cameras(self, dataset: Dataset) -> tuple[str, ...]:
        """Return the cameras whose videos are here for every episode that is."""
        held = self._episodes(dataset).values()
        return tuple(name for name in dataset.cameras if all(name in names for names in held))

    def holds_buffer(self, datasets: Mapping[str, Dataset], manifest: BufferManifest) -> bool:
        """Whether the query and all sessions of a buffer are here."""
        # The query's own episode, too, of which no session is in the buffer under `no-history`.
        episodes = {(manifest.query.dataset, manifest.query.episode_index)}
        episodes |= {(entry.dataset, entry.episode_index) for entry in manifest.sessions}
        return all(
            name in datasets and self.holds(datasets[name], index) for name, index in episodes
        )

    def is_whole(self, datasets: Mapping[str, Dataset], header: ManifestHeader) -> bool:
        """Whether all files of all planned datasets are here, and the questions."""
        if header.questions is not None and not self.lists(self.root, QUESTIONS_PATH):
            return False
        return all(name in datasets and self._is_whole(datasets[name]) for name in header.datasets)

    def _is_whole(self, dataset: Dataset) -> bool:
        files = dataset.files
        return not isinstance(files, LocalFiles) or all(
            self.lists(files.root, path) for path in dataset.sums()
        )

    def _episodes(self, dataset: Dataset) -> dict[int, frozenset[str]]:
        """Return the cameras whose videos are here, by the index of each episode that is here."""
        if dataset.kind not in self._cameras:
            files = dataset.files
            episodes: dict[int, frozenset[str]] = {}
            for index in range(len(dataset)):
                data, *videos = dataset.files_of(index, dataset.cameras)
                here = {
                    path
                    for path in (data, *videos)
                    if not isinstance(files, LocalFiles) or self.lists(files.root, path)
                }
                cameras = frozenset(
                    camera
                    for camera, video in zip(dataset.cameras, videos, strict=True)
                    if video in here
                )
                if data in here and (cameras or not dataset.cameras):
                    episodes[index] = cameras
            self._cameras[dataset.kind] = episodes
        return self._cameras[dataset.kind]
