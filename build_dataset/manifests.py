"""Plan the buffers of a split: for every query episode and every condition, what it holds.

Rules 5 and 8 of the protocol; what a condition holds is `conditions.py`, of what it is made
`material.py`.
"""

import shutil
from collections.abc import Generator, Iterator
from itertools import batched
from pathlib import Path

import pyarrow.parquet as pq

from robomme_interference_data.constants import (
    FORMAT_VERSION,
    IDENTITY_PATH,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    MAX_STEPS,
    RULE_VERSION,
)
from robomme_interference_data.data.query import Query
from robomme_interference_data.errors import (
    BuildError,
    HistoryTooLongError,
)
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.manifest import (
    BufferManifest,
    ManifestDataset,
    ManifestHeader,
)
from robomme_interference_data.storage.files import (
    sha256_file,
    staging_dir,
    write_json,
)
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.parquet import writing

from .material import ManifestPlan, QueryMaterial

_BATCH = 1024
"""Rows in a row group: few bytes find one buffer."""


def planned_buffers(plan: ManifestPlan) -> Iterator[BufferManifest]:
    """Yield the manifests of all buffers: queries in canonical order, conditions as planned.

    Raises:
        PoolTooSmallError: A query needs more units than there are.
        SourceError: A query has no contradicting lesson, or a unit no raw one.
        HistoryTooLongError: A buffer exceeds the position limit.
    """
    lossy = {
        (name, e.episode_id)
        for name, dataset in plan.datasets.items()
        for e in dataset.records()
        if not e.exact
    }
    for record in sorted(plan.demonstrations.records(), key=lambda one: one.episode_id.sort_key):
        query, material = Query(plan.demonstrations, record), QueryMaterial(plan, record)
        # The largest first: fewer units begin those that are drawn for it.
        sessions = {one.name: one.sessions(material) for one in reversed(plan.conditions)}
        for condition in plan.conditions:
            entries = sessions[condition.name]
            exact = record.exact and not (
                lossy and any((one.dataset, one.source) in lossy for one in entries)
            )
            manifest = query.manifest(condition, entries, exact=exact)
            _check_length(manifest, plan.position_limit)
            yield manifest


def _check_length(manifest: BufferManifest, limit: int | None) -> None:
    """Check that a buffer and its rollout fit the systems' position embeddings (rule 8)."""
    needed = manifest.history_frames + MAX_STEPS
    if limit is not None and needed > limit:
        raise HistoryTooLongError(
            f"{manifest} needs {needed} positions ({manifest.history_frames} history frames + "
            f"{MAX_STEPS} steps); the released servers hold {limit}",
            "Leave out that condition, or --position-limit none for systems without such a limit.",
        )


def check_place(root: Path) -> None:
    """Check that nothing else lies where the manifests of a split are to be.

    Raises:
        BuildError: The folder holds something else.
    """
    out = root.resolve() / MANIFESTS
    strangers = {path.name for path in out.iterdir()} if out.is_dir() else set()
    strangers -= {MANIFEST_ROWS, MANIFEST_HEADER}
    if (strangers and not (out / MANIFEST_HEADER).is_file()) or out.is_file():
        raise BuildError(
            f"{out} exists and holds no manifests, but {min(strangers, default='is a file')}"
        )


def write_manifests(plan: ManifestPlan, root: Path) -> Iterator[int]:
    """Write the manifests of a split; yields the number of buffers done after each batch.

    The files appear whole; `manifest.json` is the last, and names the SHA-256 of the rows.

    Args:
        plan: What to write.
        root: The split; manifests of an earlier run are replaced.

    Raises:
        PoolTooSmallError, HistoryTooLongError: As `planned_buffers`.
        BuildError: The folder holds something else, or is being written by another process.
    """
    out = root.resolve() / MANIFESTS
    rows, header = out / MANIFEST_ROWS, out / MANIFEST_HEADER
    with staging_dir(out) as work:
        try:
            out.mkdir(exist_ok=True)
            check_place(root)
            written = work / rows.name
            counts = yield from _write_rows(plan, written)
            write_json(work / header.name, to_dict(_header(plan, counts, sha256_file(written))))
            # An old header must not vouch for new rows, should this end here.
            header.unlink(missing_ok=True)
            written.replace(rows)
            (work / header.name).replace(header)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _write_rows(plan: ManifestPlan, path: Path) -> Generator[int, None, dict[str, int]]:
    """Write all rows; yields the number of buffers after each batch, and returns the counts."""
    schema = arrow_schema(BufferManifest)
    buffers = sessions = 0
    with (
        writing(path) as file,
        pq.ParquetWriter(file, schema, compression="zstd") as writer,
    ):
        for batch in batched(planned_buffers(plan), _BATCH):
            writer.write_table(to_table(batch, schema), row_group_size=_BATCH)
            buffers += len(batch)
            sessions += sum(len(manifest.sessions) for manifest in batch)
            yield len(batch)
    return {"queries": len(plan.demonstrations), "buffers": buffers, "sessions": sessions}


def _header(plan: ManifestPlan, counts: dict[str, int], rows: str) -> ManifestHeader:
    return ManifestHeader(
        format_version=FORMAT_VERSION,
        rule_version=RULE_VERSION,
        seed=plan.seed,
        conditions=tuple(condition.name for condition in plan.conditions),
        position_limit=plan.position_limit,
        datasets={
            dataset.kind: ManifestDataset(
                dataset.kind,
                dataset.identity.version,
                dataset.revision,
                sha256_file(dataset.files.path(IDENTITY_PATH)),
                dataset.files.location if isinstance(dataset.files, HubFiles) else None,
            )
            for dataset in plan.datasets.values()
        },
        counts=counts,
        rows=rows,
    )
