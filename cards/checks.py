"""Check a buffer set before it is published."""

import logging
import shlex
from importlib.util import find_spec
from pathlib import Path

from robomme_interference_data.build_dataset.verify.audit import audit_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import PublishError, counted
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.storage.files import LocalFiles, with_filename

_EXTRAS = {"build": ("lerobot", "datasets"), "score": ("jinja2", "matplotlib")}
"""Extras that publishing needs, and their libraries."""


def missing_extras() -> list[str]:
    """Return the extras that publishing needs, and that are not installed."""
    return [
        extra
        for extra, libraries in _EXTRAS.items()
        if any(find_spec(library) is None for library in libraries)
    ]


def check_buffer_set(buffer_set: BufferSet, progress: WorkProgress | None = None) -> None:
    """Check hashes, rules and leaks, and that LeRobot, if installed, opens the datasets."""
    buffer_set.check_is_whole()
    violations = list(verify_buffer_set(buffer_set, progress=progress))
    if violations:
        first = violations[0]
        raise PublishError(
            f"{buffer_set.location} has {counted(len(violations), 'violation')}, such as "
            f"{first.where}: {first.what}",
            "List all violations.",
            f"verify {shlex.quote(buffer_set.location)}",
        )
    leaks = audit_buffer_set(buffer_set).leaks
    if leaks:
        raise PublishError(
            f"{buffer_set.location} has {counted(len(leaks), 'leak')}, such as {leaks[0].kind}: "
            f"{leaks[0].where}",
            "List all leaks.",
            f"verify {shlex.quote(buffer_set.location)} --audit",
        )
    for name in buffer_set.header.datasets if "build" not in missing_extras() else ():
        files = buffer_set.dataset_files(name)
        if isinstance(files, LocalFiles):  # one on the Hub was checked when it was published
            open_with_lerobot(name, files.root)


def open_with_lerobot(name: str, root: Path) -> None:
    """Open a dataset with LeRobot, and read its first and last frame."""
    from datasets import config

    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset(f"local/{name}", root=root, video_backend="pyav")
        for index in (0, len(dataset) - 1):
            dataset[index]
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:  # LeRobot copies tables to a cache, and that disk may be full
            if isinstance(cause, OSError) and cause.errno is not None:
                with with_filename(config.HF_DATASETS_CACHE):
                    raise cause from None
            cause = cause.__cause__
        raise PublishError(
            f"LeRobot cannot open {root}: {type(error).__name__}: {error}",
            "The files match their recorded hashes: check the version of lerobot.",
            "doctor",
        ) from error
    finally:
        logging.disable(before)
