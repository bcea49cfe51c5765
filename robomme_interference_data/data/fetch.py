"""Download what a plan lists of a published buffer set, and copy it into a folder."""

import logging
import shutil
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from robomme_interference_data.constants import FETCH_RECORD, FORMAT_VERSION, MANIFEST_PATH
from robomme_interference_data.errors import HashMismatchError, counted
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.manifest import FetchRecord
from robomme_interference_data.storage.files import atomic_path, sha256_file, write_json
from robomme_interference_data.storage.staging import staging_dir

from .fetch_plan import FetchPart
from .fetched_copy import earlier_files

logger = logging.getLogger(__name__)

_STAGED = "copy"


def fetch(parts: Sequence[FetchPart], to: Path | None = None) -> None:
    """Download missing files; each is checked against the Hub's digest.

    If `to` is given, all files are also copied into that folder, or added to an earlier copy of the
    same buffer set there, and checked against the buffer set's digests; otherwise they stay in the
    Hub client's cache. A copy can be interrupted at any time: it is made beside the folder and
    moved there at the end, and the same call resumes.

    Raises:
        InvalidOptionError: `to` holds something else.
        BusyError: Another process is copying there.
        HashMismatchError: A file differs from its digest.
    """
    for part in parts:
        if part.unlisted:
            logger.warning(
                "%s holds %s that the buffer set does not list, such as %s: not fetched",
                part.files.describe(),
                counted(len(part.unlisted), "file"),
                part.unlisted[0],
            )
    if to is None:
        for part in parts:
            part.files.fetch(part.sizes)
        return
    to = to.resolve()
    # The first part is the buffer set itself; the others are repositories that it refers to.
    location = parts[0].files.location
    earlier = earlier_files(to, location, parts[0].files.path(MANIFEST_PATH))
    record = FetchRecord(FORMAT_VERSION, location, earlier)
    with staging_dir(to) as staging:
        for part in parts:
            _copy(part, staging / _STAGED / part.folder, to / part.folder)
        copied = {Path(part.folder, path).as_posix() for part in parts for path in part.sizes}
        _move(staging / _STAGED, to, record, copied)


def _copy(part: FetchPart, staged: Path, to: Path) -> None:
    """Copy what a folder lacks into its staging folder, and check it."""

    def is_there(path: str) -> bool:
        places = (to / path, staged / path)
        # What has no digest in the buffer set, such as the card, is copied again each time.
        return path in part.sums and any(
            place.is_file() and sha256_file(place) == part.sums[path] for place in places
        )

    lacking = [path for path in part.sizes if not is_there(path)]
    part.files.fetch(lacking)
    for path in lacking:
        with atomic_path(staged / path) as partial:
            shutil.copyfile(part.files.path(path), partial)
            if path in part.sums and sha256_file(partial) != part.sums[path]:
                raise HashMismatchError(
                    f"{path} of {part.files.describe()} does not have the SHA-256 that the buffer "
                    "set records",
                    "Ask its publisher to publish it again.",
                )


def _move(staged: Path, to: Path, record: FetchRecord, copied: Collection[str]) -> None:
    """Move files from the staging folder, and record all that the copy holds then.

    The record is there first, so that the next call knows the folder if the process is killed in
    between; the header of the manifests, without which the folder is no buffer set, comes last.
    """
    if not (to / FETCH_RECORD).is_file():
        write_json(to / FETCH_RECORD, to_dict(record))
    for path in sorted(copied, key=lambda path: (path == MANIFEST_PATH, path)):
        if (staged / path).is_file():
            (to / path).parent.mkdir(parents=True, exist_ok=True)
            (staged / path).replace(to / path)
    files = tuple(sorted({*record.files, *copied}))
    write_json(to / FETCH_RECORD, to_dict(replace(record, files=files)))
