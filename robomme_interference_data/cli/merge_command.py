"""The command `merge`."""

from pathlib import Path
from typing import Annotated

import typer

from robomme_interference_data.constants import SHARD_PATH

from .console import check_output
from .options import AsJson


def merge(
    shards: Annotated[list[Path], typer.Argument(help="Folders of the shards of a run or build.")],
    out: Annotated[Path, typer.Option(help="New folder of the run or the buffer set.")],
    as_json: AsJson = False,
) -> None:
    """Merge the shards of a run or of a build.

    The shards must have the same settings, except those that cannot change a result. Of a run,
    missing and duplicate rollouts are listed; the merged run can be scored like any other, and
    evaluate with its folder as --out runs what is missing. A build needs all shards: the buffer
    set is the one that a single build writes, byte for byte. After an interruption, re-run the same
    command to resume.

    Examples:
    ```
    robomme-interference merge runs/shard-1 runs/shard-2 --out runs/whole
    robomme-interference merge shards/1 shards/2 --out my-buffers
    ```
    """
    from robomme_interference_data.build_dataset.commands import merge_builds
    from robomme_interference_data.evaluate.commands import merge_shards

    check_output(out)
    builds = any((folder / SHARD_PATH).is_file() for folder in shards)
    (merge_builds if builds else merge_shards)(shards, out, as_json=as_json)
