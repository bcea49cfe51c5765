"""Plan the buffers of a buffer set: for every query episode and every condition, what it holds.

Rules 5 and 8 of the protocol; what a condition holds is `schema/conditions.py`, what sessions there
are `data/query_sessions.py`.
"""

import shutil
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import batched
from pathlib import Path

import pyarrow.parquet as pq

from robomme_interference_data.constants import (
    ACTION,
    DEMONSTRATIONS,
    DISTRACTORS,
    FORMAT_VERSION,
    IDENTITY_PATH,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    MAX_STEPS,
    OPTIONAL_DATASETS,
    POSITION_LIMIT,
    RULE_VERSION,
    SHIFTED,
    UNITS,
)
from robomme_interference_data.data.buffer_set import pending_rows
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.query_sessions import QuerySessions, SessionSource
from robomme_interference_data.errors import (
    BuildError,
    InvalidOptionError,
    SourceError,
)
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, Condition, in_order
from robomme_interference_data.schema.manifest import (
    BufferManifest,
    ManifestDataset,
    ManifestHeader,
)
from robomme_interference_data.storage.files import Files, LocalFiles, sha256_file, write_json
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.parquet import writing
from robomme_interference_data.storage.staging import staging_dir

_BATCH = 1024
"""Rows in a row group: few bytes find one buffer."""


@dataclass(frozen=True)
class ManifestPlan:
    """All that decides the manifests.

    Attributes:
        source: The datasets of the buffer set, and the seed of the draw.
        conditions: For which buffers are planned, in order.
        position_limit: Longest history plus rollout that the systems hold; None for no limit.
    """

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


def in_folder(root: Path) -> dict[str, Files]:
    """Return where the datasets of a buffer set lie that is built in a folder."""
    further = (name for name in OPTIONAL_DATASETS if (root / name / IDENTITY_PATH).is_file())
    return {name: LocalFiles(root / name) for name in (DEMONSTRATIONS, DISTRACTORS, *further)}


def plan_manifests(
    places: Mapping[str, Files],
    conditions: Sequence[str | Condition] = DEFAULT_CONDITIONS,
    seed: int = 0,
    position_limit: int | None = POSITION_LIMIT,
) -> ManifestPlan:
    """Check that the datasets of a buffer set and the options fit each other.

    Args:
        places: Where the datasets of the buffer set lie, by name; see `in_folder`.
        conditions: For which buffers are planned.
        seed: Seed of the draw.
        position_limit: See `ManifestPlan`.
    """
    ordered = in_order(conditions)
    check_needs(ordered, places)
    opened = {}
    for name, files in places.items():
        opened[name] = dataset = Dataset(files)
        if dataset.kind != name:
            raise InvalidOptionError(
                f"{files.describe()} is a dataset of {dataset.kind}",
                f"Put the {name} there.",
                f"build {name} --source KIND:PATH --out {files.location}",
            )
    _check_features(opened)
    for name in UNITS.keys() & opened.keys():
        splits = {record.episode_id.split for record in opened[name].records()}
        if splits != {"train"}:
            raise SourceError(
                "distractor units must come from train episodes, so that no query's own scene "
                f"leaks into another buffer; found {', '.join(sorted(splits))}",
                f'Build the {name} with split="train".',
            )
    if SHIFTED in opened:
        _check_scenes(opened[SHIFTED], opened[DEMONSTRATIONS])
    return ManifestPlan(SessionSource(opened, seed), ordered, position_limit)


def check_needs(conditions: Iterable[Condition], there: Collection[str]) -> None:
    """Check that a buffer set has the datasets that conditions need.

    Args:
        conditions: The conditions.
        there: Names of the datasets that it has.
    """
    for condition in conditions:
        for name in condition.kind.needs:
            if name not in there:
                raise SourceError(
                    f"{condition} needs the dataset {name}, which the buffer set lacks",
                    f"Build it first, or leave {condition} out.",
                    f"build {name} --source KIND:PATH --out BUFFER_SET/{name}",
                )


def _check_features(datasets: Mapping[str, Dataset]) -> None:
    """Check that sessions of all datasets can follow one another in a buffer."""
    shown = {
        name: {feature: s for feature, s in one.features.items() if feature != ACTION}
        for name, one in datasets.items()
    }
    for name, features in shown.items():
        if features != shown[DEMONSTRATIONS]:
            raise SourceError(
                "sessions of the datasets cannot follow one another in a buffer: the "
                f"demonstrations have {shown[DEMONSTRATIONS]}, the {name} {features}",
                "Build all with the same `cameras`, from sources with the same sizes.",
            )


def _check_scenes(shifted: Dataset, base: Dataset) -> None:
    """Check that views under shifts are of the scenes of the demonstrations, and of all."""
    found, wanted = ([*one.identity.sources] for one in (shifted, base))
    why = f"was built from {found}, the demonstrations from {wanted}"
    if all(one in wanted for one in found):
        there, asked = ({r.episode_id for r in one.records()} for one in (shifted, base))
        why = f"lacks {min(asked - there)}" if asked - there else ""
    if why:
        raise SourceError(
            f"{shifted.files.describe()} {why}",
            "Build it of all query episodes, or remove it.",
            f"build {SHIFTED}",
        )


def planned_buffers(plan: ManifestPlan) -> Iterator[BufferManifest]:
    """Yield the manifests of all buffers: queries in canonical order, conditions as planned."""
    for record in sorted(plan.demonstrations.records(), key=lambda one: one.episode_id.sort_key):
        sessions = QuerySessions(plan.source, record)
        # The largest first: fewer units begin those that are drawn for it.
        buffers = {one.name: sessions.buffer(one) for one in reversed(plan.conditions)}
        for condition in plan.conditions:
            _check_length(buffers[condition.name], plan.position_limit)
            yield buffers[condition.name]


def _check_length(manifest: BufferManifest, limit: int | None) -> None:
    """Check that a buffer and its rollout fit the systems' position embeddings (rule 8)."""
    needed = manifest.history_frames + MAX_STEPS
    if limit is not None and needed > limit:
        raise InvalidOptionError(
            f"{manifest} needs {needed} positions ({manifest.history_frames} history frames + "
            f"{MAX_STEPS} steps); the released servers hold {limit}",
            'Leave out that condition, or set position_limit="none" for systems without a limit.',
        )


def check_place(root: Path) -> None:
    """Check that nothing else lies where the manifests of a buffer set are to be."""
    out = root.resolve() / MANIFESTS
    strangers = {path.name for path in out.glob("[!.]*")} - {MANIFEST_ROWS, MANIFEST_HEADER}
    if (strangers and not (out / MANIFEST_HEADER).is_file()) or out.is_file():
        raise BuildError(
            f"{out} exists and holds no manifests, but {min(strangers, default='is a file')}"
        )


def write_manifests(plan: ManifestPlan, root: Path) -> Iterator[int]:
    """Write the manifests of a buffer set; yields the number of buffers done after each batch.

    Whenever it is interrupted, the buffer set has either the earlier manifests or the new ones: until
    `manifest.json` is replaced, the new rows lie beside the old ones under a name that it tells.

    Args:
        plan: What to write.
        root: The buffer set; manifests of an earlier run are replaced.
    """
    out = root.resolve() / MANIFESTS
    rows, header = out / MANIFEST_ROWS, out / MANIFEST_HEADER
    with staging_dir(out) as work:
        try:
            out.mkdir(exist_ok=True)
            check_place(root)
            written = work / rows.name
            counts = yield from _write_rows(plan, written)
            made = _header(plan, counts, sha256_file(written))
            write_json(work / header.name, to_dict(made))
            pending = out.parent / pending_rows(made)
            written.replace(pending)
            (work / header.name).replace(header)
            pending.replace(rows)
            for leftover in out.glob(".*.parquet"):  # of a run that was interrupted
                leftover.unlink()
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
    )
