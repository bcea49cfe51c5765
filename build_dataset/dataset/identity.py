"""Complete a LeRobot dataset: add per-episode columns, identity, report and SHA-256 sums.

LeRobot 0.6 has no interface for writing per-episode columns, but reads all columns of
`meta/episodes`: `LeRobotDatasetMetadata.filter_episodes` can select by them. So they are added
there. LeRobot's tools that merge datasets or change their features and tasks keep them; those that
delete episodes or split a dataset drop them, and do not accept the lossless codec. Loading reads a
copy of that table without LeRobot's statistics, which are most of its bytes.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DATASET_FOLDERS,
    EPISODES_DIR,
    FORMAT_VERSION,
    IDENTITY_PATH,
    PAPER_UNIT,
    RECORDS_PATH,
    REPORT_PATH,
    STATS_PATH,
    SUMS_PATH,
    UNITS,
    Unit,
)
from robomme_interference_data.data.dataset import revision_of
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.records import Counts, DatasetIdentity, EpisodeRecord
from robomme_interference_data.storage.files import (
    all_files,
    format_sums,
    is_hidden,
    sha256_file,
    write_json,
    write_text,
)
from robomme_interference_data.storage.parquet import open_parquet, writing

_LEROBOT_FIELDS = ("episode_index", "length")
"""Fields of a record that LeRobot writes."""


def listed_files(root: Path) -> list[str]:
    """Return the files of a dataset whose SHA-256 is recorded in it.

    The identity holds that of the sums, and an index has its own hashes.
    """
    unlisted = (IDENTITY_PATH, SUMS_PATH)
    return [
        path
        for path in all_files(root)
        if path.split("/")[0] in DATASET_FOLDERS and path not in unlisted and not is_hidden(path)
    ]


def identity_of(
    records: Sequence[EpisodeRecord],
    info: Mapping[str, Any],
    kind: str,
    version: str,
    codec: str,
    sources: Iterable[dict[str, Any]],
    sums: str = "",
    unit: Unit = PAPER_UNIT,
) -> DatasetIdentity:
    """Return the identity of a dataset with these episodes and this `info.json`.

    `unit` is the distractors'.
    """
    families = Counter(record.episode_id.family for record in records)
    features = {name for record in records for name in record.feature_sha256}
    cameras = sorted(name for name in features if name.startswith(CAMERA_PREFIX))
    identity = DatasetIdentity(
        format_version=FORMAT_VERSION,
        kind=kind,
        version=version,
        revision="",
        exact=all(record.exact for record in records),
        codec=codec,
        cameras=tuple(name.removeprefix(CAMERA_PREFIX) for name in cameras),
        unit=unit.in_dataset(kind).recorded() if kind in UNITS else None,
        simulators=tuple(sorted({record.simulator for record in records if record.simulator})),
        sources=tuple(sources),
        counts=Counts(len(records), sum(record.length for record in records), dict(families)),
        sums=sums,
    )
    return replace(identity, revision=revision_of(identity, info, records))


def complete_dataset(
    root: Path, records: Sequence[EpisodeRecord], identity: DatasetIdentity, skipped: dict[str, str]
) -> None:
    """Complete a dataset that LeRobot's writer has finished; fills in `sums` of the identity.

    `skipped` maps the ids of episodes that yielded nothing to the reasons.
    """
    _add_columns(root, records)
    _sort_statistics(root / STATS_PATH)
    write_json(root / REPORT_PATH, report_of(identity, skipped))
    write_text(root / SUMS_PATH, format_sums(root, listed_files(root)))
    identity = replace(identity, sums=sha256_file(root / SUMS_PATH))
    write_json(root / IDENTITY_PATH, to_dict(identity))


@dataclass(frozen=True)
class SkippedEpisode:
    """An episode that yielded nothing."""

    episode_id: Annotated[EpisodeId, "Its id."]
    why: Annotated[str, "The reason."]


@dataclass(frozen=True)
class BuildReport:
    """`meta/build_report.json`."""

    format_version: Annotated[int, "Of the files."]
    kind: Annotated[str, "Name of the dataset in a buffer set."]
    counts: Annotated[dict[str, Any], "What the identity counts, and `skipped` episodes."]
    skipped: Annotated[tuple[SkippedEpisode, ...], "Episodes that yielded nothing, by id."]

    @property
    def reasons(self) -> dict[str, str]:
        """Id to reason of the skipped episodes."""
        return {str(episode.episode_id): episode.why for episode in self.skipped}


def report_of(identity: DatasetIdentity, skipped: dict[str, str]) -> dict[str, Any]:
    """Return the build report of a dataset as plain values; see `complete_dataset`."""
    return {
        "format_version": FORMAT_VERSION,
        "kind": identity.kind,
        "counts": {**to_dict(identity.counts), "skipped": len(skipped)},
        "skipped": [{"episode_id": name, "why": why} for name, why in sorted(skipped.items())],
    }


def _add_columns(root: Path, records: Sequence[EpisodeRecord]) -> None:
    """Rewrite meta/episodes as one file with our columns after LeRobot's, and its lean copy."""
    paths = sorted((root / EPISODES_DIR).rglob("*.parquet"))
    table = pa.concat_tables([open_parquet(path).read() for path in paths]).combine_chunks()
    table = table.sort_by("episode_index")
    for name in ("meta/episodes/chunk_index", "meta/episodes/file_index"):
        position = table.schema.get_field_index(name)
        table = table.set_column(position, name, pa.array([0] * len(table), pa.int64()))
    schema = arrow_schema(EpisodeRecord, sorted(records[0].feature_sha256))
    added = to_table(records, schema)
    for field in schema:
        if field.name not in _LEROBOT_FIELDS:
            table = table.append_column(field, added[field.name])
    for path in paths:
        path.unlink()
    _write_table(paths[0], table)
    lean = [name for name in table.column_names if not name.startswith("stats/")]
    _write_table(root / RECORDS_PATH, table.select(lean))


def _write_table(path: Path, table: pa.Table) -> None:
    """Write a table that is always read whole, as one row group without statistics.

    Most of it are distinct SHA-256 sums, so dictionaries would only add bytes. It is fetched with
    the first buffer, so it is compressed as well as possible.
    """
    with writing(path) as file:
        pq.write_table(
            table.replace_schema_metadata(None),
            file,
            row_group_size=len(table),
            compression="zstd",
            compression_level=19,
            use_dictionary=False,
            write_statistics=False,
            store_schema=False,
        )


def _sort_statistics(path: Path) -> None:
    """Sort the features: LeRobot writes them in set order, which differs between runs."""
    statistics = json.loads(path.read_text(encoding="utf-8"))
    text = json.dumps(statistics, indent=4, sort_keys=True, allow_nan=False)
    write_text(path, text + "\n")
