"""Write what would be published into a folder: the split's repository, its demonstrations in it."""

import shutil
from pathlib import Path

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    IDENTITY_PATH,
    INDEX_DIR,
    MANIFEST_PATH,
    MANIFESTS,
    OPTIONAL_DATASETS,
)
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.errors import PublishError
from robomme_interference_data.storage.files import (
    LocalFiles,
    all_files,
    replace_folder,
    sha256_file,
    staging_dir,
)

from . import render
from .publish import demonstrations_of, units_of
from .publish_config import PublishConfig
from .tree import Content, Tree

_CARD = (render.README, render.STRIP, render.CROISSANT)
_OURS = {"data", "meta", "videos", INDEX_DIR, MANIFESTS, DEMONSTRATIONS, *OPTIONAL_DATASETS, *_CARD}
"""What stands at the root of an export."""


def exported_tree(split: Split, config: PublishConfig) -> Tree:
    """Return the files of a split's repository, and below `demonstrations/` those of the other one.

    Demonstrations that are only on the Hub are left there.

    Raises:
        InterferenceError: The split cannot be read.
    """
    base = split.header.datasets[DEMONSTRATIONS].place
    base = base if base and "@" in base else None
    units = units_of(split, config, base)
    tree = units.tree(config.wanted or units.first)
    if isinstance(split.place(DEMONSTRATIONS), LocalFiles):
        goods = demonstrations_of(split, config)
        files = goods.tree(config.wanted or goods.first)
        tree |= {f"{DEMONSTRATIONS}/{path}": content for path, content in files.items()}
    return tree


def write_tree(tree: Tree, out: Path) -> bool:
    """Write files into a folder, all of them or none; an earlier export there is replaced.

    Returns:
        Whether it was written: False if all of it was there.

    Raises:
        PublishError: The folder holds something else.
        BuildError: Another process writes it.
    """
    there = all_files(out) if out.is_dir() else []
    _check_ours(out, there)
    if there == sorted(tree) and all(_holds(out / path, tree[path]) for path in there):
        return False
    out = out.resolve()
    with staging_dir(out) as work:
        made = work / "made"
        try:
            shutil.rmtree(made, ignore_errors=True)
            for path, content in tree.items():
                (made / path).parent.mkdir(parents=True, exist_ok=True)
                if isinstance(content.source, Path):
                    shutil.copyfile(content.source, made / path)
                else:
                    (made / path).write_bytes(content.source)
            replace_folder(made, out)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    return True


def _check_ours(out: Path, there: list[str]) -> None:
    """Check that a folder holds an earlier export and nothing else, or nothing.

    Raises:
        PublishError: It holds something else, such as a `.git`, or is no folder.
    """
    ours = {MANIFEST_PATH, IDENTITY_PATH} <= {*there}
    others = [path for path in there if path.split("/")[0] not in _OURS]
    if others or (there and not ours) or (out.exists() and not out.is_dir()):
        what = f", but {others[0]}" if others else ""
        raise PublishError(
            f"{out} is there, and is nothing that was exported{what}", "Give --to another folder."
        )


def _holds(path: Path, content: Content) -> bool:
    return path.stat().st_size == content.size and sha256_file(path) == content.sha256
