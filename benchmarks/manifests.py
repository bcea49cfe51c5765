"""How fast buffers are planned and written: 10,000 queries under ten conditions.

Episode tables are made up, with the columns of real datasets; no video is needed.
Every run is a process of its own. The obvious alternative writes the same rows with a loop over
dictionaries and `pyarrow.Table.from_pylist`, with the same draw.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from hashlib import sha256
from itertools import batched
from pathlib import Path
from statistics import median

import pyarrow as pa
import pyarrow.parquet as pq
from common import (
    in_fresh_process,
    megabytes,
    peak_memory,
    positive,
    print_machine,
    print_table,
    run,
)
from support.made_up import record, write_metadata

from robomme_interference_data.build_dataset.manifests import (
    plan_manifests,
    planned_buffers,
    write_manifests,
)
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    FAMILIES,
    FRONT,
    MANIFEST_ROWS,
    MANIFESTS,
    STATE,
    WRIST,
)
from robomme_interference_data.schema.codec import arrow_schema, to_dict
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.records import EpisodeRecord, SpanDigests

_SPANS = ("first", "second", "last", "query")
SHAPES = {FRONT: (256, 256, 3), WRIST: (256, 256, 3), STATE: (8,)}
CONDITIONS = ("no-history", "k0", "k1", "k2", "k3", "k4", "k5", "k6", "k7", "k15")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    sizes = (1_000, 10_000)
    parser.add_argument("--queries", type=positive, nargs="+", default=sizes, help="query episodes")
    parser.add_argument("--units", type=positive, default=2_700, help="units in the pool")
    parser.add_argument("--rounds", type=positive, default=3, help="repetitions of each size")
    options = parser.parse_args()
    rows = []
    for size in options.queries:
        with tempfile.TemporaryDirectory(prefix="interference-manifests-") as name:
            root = Path(name)
            write_dataset(root / DISTRACTORS, DISTRACTORS, options.units)
            write_dataset(root / DEMONSTRATIONS, DEMONSTRATIONS, size)
            runs = [
                [in_fresh_process(timed, way, root) for way in (written, plainly)]
                for _ in range(options.rounds)
            ]
            seconds = [median(run[way][0] for run in runs) for way in (0, 1)]
            ratio = median(run[0][0] / run[1][0] for run in runs)
            memory = max(run[0][1] for run in runs)
            size_bytes = (root / MANIFESTS / MANIFEST_ROWS).stat().st_size
            rows.append(
                [
                    f"{size:,}",
                    f"{size * len(CONDITIONS):,}",
                    f"{seconds[0]:.1f}",
                    f"{seconds[1]:.1f}",
                    f"{ratio:.2f}",
                    megabytes(memory),
                    megabytes(size_bytes),
                ]
            )
    print_machine("pyarrow")
    title = (
        f"Buffers of made-up queries under {len(CONDITIONS)} conditions, {options.units:,} units; "
        f"medians of {options.rounds} runs."
    )
    heads = (">queries", ">buffers", ">s", ">row by row, s", ">ratio", ">peak MB", ">file MB")
    print_table(title, heads, rows)


def timed(way: Callable[[Path], None], root: Path) -> tuple[float, int]:
    """Return the seconds of one way, and the memory that it took over the start."""
    before, began = peak_memory(), time.perf_counter()
    way(root)
    return time.perf_counter() - began, peak_memory() - before


def written(root: Path, conditions: Sequence[str] = CONDITIONS) -> None:
    """Write the manifests as `build --only manifests` does, without a limit of positions."""
    plan = plan_manifests(datasets_in(root), conditions, position_limit=None)
    for _ in write_manifests(plan, root):
        pass


def plainly(root: Path) -> None:
    """Write the same rows one by one."""
    schema = arrow_schema(BufferManifest)
    buffers = planned_buffers(plan_manifests(datasets_in(root), CONDITIONS, position_limit=None))
    with pq.ParquetWriter(root / "plain.parquet", schema, compression="zstd") as writer:
        for batch in batched(buffers, 1024):
            rows = [to_dict(manifest) for manifest in batch]
            writer.write_table(pa.Table.from_pylist(rows, schema=schema))


def write_dataset(root: Path, kind: str, count: int) -> None:
    """Write the metadata of a dataset with so many episodes."""
    write_metadata(root, kind, (made_up(kind, index) for index in range(count)), SHAPES)


def made_up(kind: str, index: int) -> EpisodeRecord:
    """Return the record of an episode that was never recorded."""
    units = kind == DISTRACTORS
    number, family = divmod(index, len(FAMILIES))
    spans = {name: sha256(f"{index} {name}".encode()).hexdigest() for name in _SPANS}
    digests = {name: sha256(f"{kind} {index} {name}".encode()).hexdigest() for name in SHAPES}
    return record(
        kind,
        f"{FAMILIES[family]}/{'train' if units else 'test'}/{number}",
        index,
        lesson=50 + 13 * index % 700,
        goals=("watch the video carefully, then do the task again", "do it again"),
        seed=index,
        difficulty="easy",
        simulator="made-up",
        feature_sha256=digests,
        span_sha256=None if units else SpanDigests(**spans),
    )


if __name__ == "__main__":
    run(main)
