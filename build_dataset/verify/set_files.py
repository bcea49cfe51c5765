"""Which files belong to a buffer set; `verify` names all others."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from robomme_interference_data.constants import (
    DATASET_FOLDERS,
    DATASETS,
    INDEX_DIR,
    INFO_PATH,
    MANIFESTS,
    QUESTIONS_PATH,
)
from robomme_interference_data.storage.files import all_files, is_hidden
from robomme_interference_data.storage.staging import staging_path

_BESIDE = r"(README|LICENSE)[^/]*"
"""Cards."""

_IN_DATASET = re.compile(rf"({'|'.join((*DATASET_FOLDERS, INDEX_DIR))})/.*|{_BESIDE}")
_IN_SET = re.compile(rf"{MANIFESTS}/.*|{QUESTIONS_PATH}|{_BESIDE}")


def unfinished_builds(root: Path) -> list[str]:
    """Return the names of a buffer set's folders whose build has begun and not ended."""
    return [name for name in (*DATASETS, MANIFESTS) if staging_path(root / name).is_dir()]


def further_files(root: Path, datasets: Collection[str]) -> Iterator[str]:
    """Yield the paths of the files of a folder that belong to no dataset or buffer set.

    Files in the folders of datasets and manifests count as theirs here, and are checked with them;
    those of unfinished builds are left out, and hidden ones, such as those of Git, of the Hub's
    client and of macOS.

    Args:
        root: Folder of a buffer set, or of a single dataset.
        datasets: Names of the buffer set's datasets; empty for a single dataset.
    """
    has_dataset = (root / INFO_PATH).is_file()  # a published buffer set has its units at the root
    staging = {staging_path(root / name).name for name in unfinished_builds(root)}
    for path in all_files(root):
        if is_hidden(path):
            continue
        folder, _, inner = path.partition("/")
        if folder in staging:
            continue
        if folder in datasets:
            patterns, inside = [_IN_DATASET], inner
        else:
            patterns, inside = [], path
            if has_dataset:
                patterns.append(_IN_DATASET)
            if datasets:
                patterns.append(_IN_SET)
        if not any(pattern.fullmatch(inside) for pattern in patterns):
            yield path
