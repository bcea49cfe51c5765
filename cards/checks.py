"""What has to hold before a buffer set is published: every hash and rule, no leak, LeRobot opens it."""

import logging
from collections.abc import Sized
from pathlib import Path

from robomme_interference_data.build_dataset.audit import audit_buffer_set
from robomme_interference_data.build_dataset.lerobot_writer import require_lerobot
from robomme_interference_data.build_dataset.verify import verify_buffer_set
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import PublishError
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.storage.files import LocalFiles, with_filename


def check_buffer_set(buffer_set: BufferSet, progress: WorkProgress | None = None) -> None:
    """Check that a buffer set is fit to be published; raise a `PublishError` if it is not."""
    require_lerobot()
    violations = list(verify_buffer_set(buffer_set, progress=progress))
    if violations:
        first = violations[0]
        raise PublishError(
            f"{buffer_set.location} is not as recorded: {_number(violations, 'violation')}, such as "
            f"{first.where}: {first.what}",
            "List all of them.",
            f"verify {buffer_set.location}",
        )
    leaks = audit_buffer_set(buffer_set).leaks
    if leaks:
        raise PublishError(
            f"{buffer_set.location} leaks: {_number(leaks, 'leak')}, such as {leaks[0].kind}: "
            f"{leaks[0].where}",
            "List all of them.",
            f"audit {buffer_set.location}",
        )
    for name in buffer_set.header.datasets:
        place = buffer_set.dataset_files(name)
        if isinstance(place, LocalFiles):  # one on the Hub was checked when it was published
            open_with_lerobot(name, place.root)


def open_with_lerobot(name: str, root: Path) -> None:
    """Open a dataset as its users will, and read its first and last frame."""
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
            "Its files are as recorded: check the version of lerobot.",
            "doctor",
        ) from error
    finally:
        logging.disable(before)


def _number(found: Sized, what: str) -> str:
    return f"{len(found)} {what}{'s' * (len(found) > 1)}"
