"""Folders for Unix sockets, whose paths the system keeps short."""

import os
import tempfile
from pathlib import Path

from robomme_interference_data.errors import WorkerError

_LONGEST = 103
"""Bytes of a socket's path, at most: macOS allows 103, Linux 107."""

_NAME = 4
"""Bytes of a socket's name in its folder, at most."""


def socket_folder(prefix: str) -> Path:
    """Make a temporary folder in which sockets can be made.

    Raises:
        WorkerError: The folder for temporary files has too long a path.
    """
    folder = Path(tempfile.mkdtemp(prefix=prefix))
    if len(os.fsencode(folder)) + 1 + _NAME > _LONGEST:
        folder.rmdir()
        raise long_path_error(tempfile.gettempdir())
    return folder


def long_path_error(folder: object) -> WorkerError:
    """Return the error for a folder of temporary files that is too long for sockets in it."""
    return WorkerError(
        f"the folder for temporary files has too long a path for sockets: {folder}",
        "Set TMPDIR to a shorter one, such as TMPDIR=/tmp (for Ray alone: RAY_TMPDIR).",
    )
