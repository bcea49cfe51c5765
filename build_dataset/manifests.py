"""Plan the buffers of a buffer set, one for every query episode and condition.

Rules 5 and 8 of the protocol. `schema/conditions.py` defines the content of a condition, and
`data/query_sessions.py` provides the sessions.
"""

import shutil
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import batched
from pathlib import Path

import pyarrow.parquet as pq

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    FORMAT_VERSION,
    IDENTITY_PATH,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    MAX_STEPS,
    POSITION_LIMIT,
    QUESTIONS_PATH,
    RULE_VERSION,
    SHIFTED,
    UNITS,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.query_sessions import QuerySessions, SessionSource
from robomme_interference_data.data.set_files import pending_rows
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError, named
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, Condition, in_order
from robomme_interference_data.schema.draw import too_long
from robomme_interference_data.schema.manifest import (
    BufferManifest,
    ManifestDataset,
    ManifestHeader,
)
from robomme_interference_data.storage.files import Files, sha256_file, write_json
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.parquet import writing
from robomme_interference_data.storage.staging import staging_dir

from .manifest_checks import check_executions, check_features, check_needs, check_scenes

_BATCH = 1024
"""Rows in a row group: finding one buffer reads few bytes."""


@dataclass(frozen=True)
class ManifestPlan:
    """Everything that determines the manifests; a position limit of None is no limit."""

    source: SessionSource
    conditions: tuple[Condition, ...]
    position_limit: int | None = POSITION_LIMIT

    @property
    def datasets(self) -> Mapping[str, Dataset]:
        """The datasets of the buffer set by name."""
        return self.source.datasets

    @property
    def demonstrations(self) -> Dataset:
        """The query episodes."""
        return self.datasets[DEMONSTRATIONS]


def plan_manifests(
    files: Mapping[str, Files],
    conditions: Sequence[str | Condition] = DEFAULT_CONDITIONS,
    seed: int = 0,
    position_limit: int | None = POSITION_LIMIT,
) -> ManifestPlan:
    """Check that the datasets of a buffer set, by name, and the options fit each other."""
    ordered = in_order(conditions)
    check_needs(ordered, files)
    opened = {}
    for name, dataset_files in files.items():
        opened[name] = dataset = Dataset(dataset_files)
        if dataset.kind != name:
            raise InvalidOptionError(
                f"{dataset_files.describe()} is a dataset of {dataset.kind}; expected {name}",
                f"Move it away, and build the {name} in its place.",
                f"build BUFFER_SET --only {name} --source KIND:PATH",
            )
    check_features(opened)
    for name in sorted({*UNITS} & opened.keys()):
        splits = {record.episode_id.split for record in opened[name].records()}
        if splits != {"train"}:
            raise SourceError(
                "distractor units must come from train episodes, so that no query's scene leaks "
                f"into another buffer; found {', '.join(sorted(splits))}",
                f"Move {opened[name].files.describe()} away, and build the {name} with "
                f"{named('split', 'train')}.",
            )
        if DISTRACTORS in opened and opened[name].unit != opened[DISTRACTORS].unit.in_dataset(name):
            raise SourceError(
                f"the {name} have units of {opened[name].unit}, the distractors of "
                f"{opened[DISTRACTORS].unit}",
                f"Build both with the same {named('unit')}.",
            )
    if SHIFTED in opened:
        check_scenes(opened[SHIFTED], opened[DEMONSTRATIONS])
    if EXECUTIONS in opened:
        check_executions(opened[EXECUTIONS], opened[DEMONSTRATIONS])
    return ManifestPlan(SessionSource(opened, seed), ordered, position_limit)


def planned_buffers(plan: ManifestPlan) -> Iterator[BufferManifest]:
    """Yield the manifests of all buffers: queries in canonical order, conditions as planned."""
    for record in sorted(
        plan.demonstrations.records(), key=lambda record: record.episode_id.sort_key
    ):
        sessions = QuerySessions(plan.source, record)
        # The largest first: smaller draws are the beginning of it.
        buffers = {
            condition.name: sessions.buffer(condition) for condition in reversed(plan.conditions)
        }
        for condition in plan.conditions:
            manifest, limit = buffers[condition.name], plan.position_limit
            frames = manifest.history_frames
            if limit is not None and frames + MAX_STEPS > limit:  # rule 8
                raise too_long(str(manifest), str(frames), frames, limit)
            yield manifest


def check_manifests_folder(root: Path) -> None:
    """Check that the manifests folder of a buffer set holds nothing else."""
    out = root.resolve() / MANIFESTS
    other = {path.name for path in out.glob("[!.]*")} - {MANIFEST_ROWS, MANIFEST_HEADER}
    if (other and not (out / MANIFEST_HEADER).is_file()) or out.is_file():
        what = f"holds {min(other)}" if other else "is a file"
        raise BuildError(f"{out} exists and {what}; expected a folder with manifests only")


def write_manifests(plan: ManifestPlan, root: Path) -> Iterator[int]:
    """Write the manifests of a buffer set; yields the number of buffers done after each batch.

    After an interruption at any time, the buffer set has either the old manifests or the new ones:
    the new rows are first stored beside the old ones, under a name that follows from the new
    `manifest.json`.
    """
    out = root.resolve() / MANIFESTS
    rows, header = out / MANIFEST_ROWS, out / MANIFEST_HEADER
    with staging_dir(out) as work:
        try:
            out.mkdir(exist_ok=True)
            check_manifests_folder(root)
            written = work / rows.name
            counts = yield from _write_rows(plan, written)
            questions = root / QUESTIONS_PATH
            made = _header(
                plan,
                counts,
                sha256_file(written),
                sha256_file(questions) if questions.is_file() else None,
            )
            write_json(work / header.name, to_dict(made))
            pending = out.parent / pending_rows(made)
            written.replace(pending)
            (work / header.name).replace(header)
            pending.replace(rows)
            for leftover in out.glob(".*.parquet"):  # of an interrupted run
                leftover.unlink()
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _write_rows(plan: ManifestPlan, path: Path) -> Generator[int, None, dict[str, int]]:
    """Write all rows; yields the number of buffers of each batch, and returns the counts."""
    schema = arrow_schema(BufferManifest)
    buffers = sessions = 0
    with writing(path) as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for batch in batched(planned_buffers(plan), _BATCH):
            writer.write_table(to_table(batch, schema), row_group_size=_BATCH)
            buffers += len(batch)
            sessions += sum(len(manifest.sessions) for manifest in batch)
            yield len(batch)
    return {"queries": len(plan.demonstrations), "buffers": buffers, "sessions": sessions}


def _header(
    plan: ManifestPlan, counts: dict[str, int], rows: str, questions: str | None
) -> ManifestHeader:
    return ManifestHeader(
        format_version=FORMAT_VERSION,
        rule_version=RULE_VERSION,
        seed=plan.source.seed,
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
        questions=questions,
    )
