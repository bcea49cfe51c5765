"""What the buffer set in a folder holds and plans now."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    MANIFEST_PATH,
    MANIFESTS,
    OPTIONAL_DATASETS,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import BuildError, FormatError, MissingFileError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.storage.files import Files, LocalFiles
from robomme_interference_data.storage.hub import HubFiles


@dataclass(frozen=True)
class PlannedBuffers:
    """The buffers that a buffer set plans now: their manifests' header, and the query episodes."""

    header: ManifestHeader
    queries: frozenset[EpisodeId]

    @property
    def published_demonstrations(self) -> HubFiles | None:
        """The demonstrations on the Hub that the buffers refer to; None if they lie beside them."""
        location = self.header.datasets[DEMONSTRATIONS].location
        return None if location is None else HubFiles.parse(location)


def read_planned(root: Path) -> PlannedBuffers | None:
    """Read what the buffer set in a folder plans now; None if that is nothing."""
    if not (root / MANIFEST_PATH).is_file():
        return None
    try:
        opened = load_buffer_set(root)
        check_is_own(opened)
        return PlannedBuffers(opened.header, frozenset(opened.episode_ids))
    except (FormatError, MissingFileError) as error:
        raise FormatError(
            error.message,
            f"Restore it, or remove {root / MANIFESTS} and plan all conditions anew: which ones "
            "were planned cannot be read.",
        ) from None


def check_is_own(buffer_set: BufferSet) -> None:
    """Check that a buffer set may be changed: a copy of a published one stays as it is."""
    if buffer_set.copy is not None:
        raise BuildError(
            f"{buffer_set.location} is a copy of {buffer_set.copy.record.location}, and a "
            "published buffer set never changes",
            "Build one of your own with the same demonstrations:",
            buffer_set.planning(),
        )
    if buffer_set.header.datasets[DISTRACTORS].location == ".":
        lessons = buffer_set.dataset_files(DEMONSTRATIONS).location
        raise BuildError(
            f"{buffer_set.location} has the layout of a repository, which never changes",
            "Build one of your own with the same demonstrations:",
            f"build BUFFER_SET --demonstrations {shlex.quote(lessons)} --source KIND:PATH",
        )


def datasets_in(root: Path) -> dict[str, Files]:
    """Return the datasets of the buffer set that is built in a folder, by name."""
    optional = (name for name in OPTIONAL_DATASETS if (root / name / IDENTITY_PATH).is_file())
    return {name: LocalFiles(root / name) for name in (DEMONSTRATIONS, DISTRACTORS, *optional)}


def datasets_of_planned(root: Path, planned: PlannedBuffers | None) -> dict[str, Files]:
    """Return the datasets of a folder, with demonstrations on the Hub if its buffers use those."""
    files = datasets_in(root)
    if planned is not None and not (root / DEMONSTRATIONS).is_dir():
        published = planned.published_demonstrations
        if published is not None:
            files[DEMONSTRATIONS] = published
    return files
