"""Write the manifests of a split: for every query episode and every k, what its buffer holds.

The rows are made in `manifest_rows.py`; here a plan is checked, and the files are written whole.
"""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from robomme_interference_data.build_dataset import manifest_rows
from robomme_interference_data.build_dataset.locks import locked
from robomme_interference_data.build_dataset.manifest_rows import ManifestPlan, ManifestRows
from robomme_interference_data.constants import (
    ACTION,
    DEMONSTRATIONS,
    DISTRACTORS,
    FORMAT_VERSION,
    MANIFEST_JSON,
    MANIFEST_JSONL,
    MANIFEST_PARQUET,
    MAX_K,
    POSITION_LIMIT,
    RULE_VERSION,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import (
    BuildError,
    InvalidOptionError,
    SourceError,
)
from robomme_interference_data.files import atomic_path, sha256_file, write_json
from robomme_interference_data.manifest_io import SCHEMA

__all__ = ["ManifestPlan", "expected_rows", "plan_manifests", "write_manifests"]

_FILES = (MANIFEST_PARQUET, MANIFEST_JSONL, MANIFEST_JSON)


def plan_manifests(
    demonstrations: Dataset,
    distractors: Dataset,
    k: Sequence[int] = (0, 1, 3, 7),
    seed: int = 0,
    position_limit: int | None = POSITION_LIMIT,
) -> ManifestPlan:
    """Check that two datasets and the options make a split.

    Raises:
        InvalidOptionError: A k is not from 0 to 63 or comes twice, or a dataset is of the wrong
            kind.
        SourceError: The datasets do not fit each other, or a unit is not of the train split.
    """
    ordered = tuple(sorted(k))
    if not ordered or len(set(ordered)) != len(ordered) or ordered[0] < 0 or ordered[-1] > MAX_K:
        raise InvalidOptionError(
            f"--k {' '.join(map(str, k))}; expected distinct numbers from 0 to {MAX_K}"
        )
    for option, dataset in ((DEMONSTRATIONS, demonstrations), (DISTRACTORS, distractors)):
        if dataset.kind != option:
            raise InvalidOptionError(
                f"--{option} {dataset.files.describe()} is a dataset of {dataset.kind}",
                f"Give the folder that robomme-interference build {option} made.",
            )
    shown, others = _shown(demonstrations), _shown(distractors)
    if shown != others:
        raise SourceError(
            f"sessions of both datasets cannot follow one another in a buffer: the demonstrations "
            f"have {shown}, the distractors {others}",
            "Build both with the same --cameras, from sources with the same sizes.",
        )
    splits = set(distractors.episodes["split"].to_pylist())
    if splits != {"train"}:
        raise SourceError(
            f"distractor units must come from train episodes, so that no query's own scene leaks "
            f"into another buffer; found {', '.join(sorted(splits))}",
            "Build the distractors with --split train.",
        )
    return ManifestPlan(demonstrations, distractors, ordered, seed, position_limit)


def _shown(dataset: Dataset) -> dict[str, tuple[int, ...]]:
    """Return the features that a buffer shows, with their shapes: cameras and state."""
    return {name: shape for name, shape in dataset.features.items() if name != ACTION}


def write_manifests(plan: ManifestPlan, out: Path) -> Iterator[int]:
    """Write the manifest files; yields the number of queries done after each batch.

    The files appear together when all are complete; `manifest.json` is the last, and names the
    SHA-256 of the others.

    Args:
        plan: What to write.
        out: Folder of the manifests; files of an earlier run are replaced.

    Raises:
        PoolTooSmallError: A query needs more units than the other families have.
        HistoryTooLongError: A buffer exceeds the position limit.
        BuildError: `out` holds something else, or is being written by another process.
    """
    out = out.resolve()
    with locked(out) as work:
        try:
            _clear(out)
            yield from _write(plan, out)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _clear(out: Path) -> None:
    """Make the folder, and remove what a killed run left half-written in it."""
    if out.is_file():
        raise BuildError(f"{out} is a file", "Choose another --out.")
    out.mkdir(parents=True, exist_ok=True)
    partial = {path for name in _FILES for path in out.glob(f".{name}.*.partial")}
    others = set(out.iterdir()) - partial - {out / name for name in _FILES}
    if others and not (out / MANIFEST_JSON).is_file():
        raise BuildError(
            f"{out} exists and holds no manifests, but {min(others).name}", "Choose another --out."
        )
    for path in partial:
        path.unlink()


def _write(plan: ManifestPlan, out: Path) -> Iterator[int]:
    rows = ManifestRows(plan)
    with (
        atomic_path(out / MANIFEST_PARQUET) as parquet,
        atomic_path(out / MANIFEST_JSONL) as jsonl,
        pq.ParquetWriter(parquet, SCHEMA, compression="zstd") as writer,
        jsonl.open("w", encoding="utf-8") as lines,
    ):
        for batch in rows.batches():
            writer.write_batch(batch.table, row_group_size=manifest_rows.BATCH)
            lines.writelines(batch.lines)
            yield batch.queries
        # An old manifest.json must not vouch for new files, should writing stop here.
        (out / MANIFEST_JSON).unlink(missing_ok=True)
    write_json(
        out / MANIFEST_JSON,
        {
            "format_version": FORMAT_VERSION,
            "rule_version": RULE_VERSION,
            "seed": plan.seed,
            "k": list(plan.k),
            "position_limit": plan.position_limit,
            "datasets": {
                dataset.kind: {
                    name: dataset.identity[name]
                    for name in ("name", "version", "revision", "exact", "counts", "simulators")
                }
                for dataset in (plan.demonstrations, plan.distractors)
            },
            "counts": rows.counts,
            "files": {
                name: {"sha256": sha256_file(out / name), "bytes": (out / name).stat().st_size}
                for name in (MANIFEST_PARQUET, MANIFEST_JSONL)
            },
        },
    )


def expected_rows(plan: ManifestPlan) -> Iterator[dict[str, Any]]:
    """Yield the rows that `write_manifests` would write, in order, as plain values."""
    for batch in ManifestRows(plan).batches():
        yield from batch.table.to_pylist()
