"""What makes a LeRobot dataset one of ours: per-episode columns, identity, report, SHA-256 sums.

LeRobot 0.6 offers no way to hand per-episode columns to its writer, but reads any that stand in
`meta/episodes`: `LeRobotDatasetMetadata.filter_episodes` can select by them. So they are added
there. LeRobot's tools that merge datasets or change their features and tasks carry them along;
those that delete episodes or split a dataset drop them, and refuse the lossless codec. What loading
reads is a copy of that table without LeRobot's statistics, which are most of its bytes.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    EPISODES_DIR,
    FORMAT_VERSION,
    IDENTITY_PATH,
    INDEX_DIR,
    MANIFESTS,
    PARTS_PATH,
    QUESTIONS_PATH,
    RECORDS_PATH,
    REPORT_PATH,
    STATS_PATH,
    SUMS_PATH,
    UNITS,
)
from robomme_interference_data.data.dataset import revision_of
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.records import Counts, DatasetIdentity, EpisodeRecord
from robomme_interference_data.storage.files import (
    all_files,
    format_sums,
    sha256_file,
    write_json,
    write_text,
)
from robomme_interference_data.storage.parquet import open_parquet, writing

_LEROBOTS = ("episode_index", "length")
"""Fields of a record that LeRobot writes."""


def listed_files(root: Path) -> list[str]:
    """Return the files of a dataset whose SHA-256 is recorded: all but the list and what it names.

    An index has a list of its own; so have the manifests, which a published buffer set has beside its
    units, and the questions, which are made anew to be checked. What people put beside a dataset
    has none: README, LICENSE, cards with `parts.json`, and hidden files.
    """
    own = (IDENTITY_PATH, SUMS_PATH)
    beside = re.compile(
        rf"(README|LICENSE|croissant)[^/]*|{QUESTIONS_PATH}|{PARTS_PATH}|\..*"
        rf"|({INDEX_DIR}|{MANIFESTS})/.*"
    )
    return [path for path in all_files(root) if path not in own and not beside.fullmatch(path)]


def identity_of(
    records: Sequence[EpisodeRecord],
    kind: str,
    version: str,
    codec: str,
    sources: Iterable[dict[str, Any]],
    sums: str = "",
) -> DatasetIdentity:
    """Return the identity of a dataset with these episodes; see `DatasetIdentity`."""
    families = Counter(record.episode_id.family for record in records)
    features = {name for record in records for name in record.feature_sha256}
    cameras = sorted(name for name in features if name.startswith(CAMERA_PREFIX))
    return DatasetIdentity(
        format_version=FORMAT_VERSION,
        kind=kind,
        version=version,
        revision=revision_of(records),
        exact=all(record.exact for record in records),
        codec=codec,
        cameras=tuple(name.removeprefix(CAMERA_PREFIX) for name in cameras),
        unit=UNITS[kind]._asdict() if kind in UNITS else None,
        simulators=tuple(sorted({one.simulator for one in records if one.simulator})),
        sources=tuple(sources),
        counts=Counts(len(records), sum(one.length for one in records), dict(families)),
        sums=sums,
    )


def complete_dataset(
    root: Path,
    records: Sequence[EpisodeRecord],
    identity: DatasetIdentity,
    skipped: dict[str, str],
) -> None:
    """Complete a dataset that LeRobot's writer has finished.

    Args:
        root: The dataset.
        records: Its episodes.
        identity: Its identity; `sums` follows from the files.
        skipped: Ids of episodes that yielded nothing, and why.
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
    why: Annotated[str, "Why it yielded nothing."]


@dataclass(frozen=True)
class BuildReport:
    """`meta/build_report.json`."""

    format_version: Annotated[int, "Of the files."]
    kind: Annotated[str, "Name of the dataset in a buffer set."]
    counts: Annotated[dict[str, Any], "What the identity counts, and `skipped` episodes."]
    skipped: Annotated[tuple[SkippedEpisode, ...], "Episodes that yielded nothing, by id."]


def report_of(identity: DatasetIdentity, skipped: dict[str, str]) -> dict[str, Any]:
    """Return the build report of a dataset as plain values.

    Args:
        identity: The dataset.
        skipped: Ids of episodes that yielded nothing, and why.
    """
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
        place = table.schema.get_field_index(name)
        table = table.set_column(place, name, pa.array([0] * len(table), pa.int64()))
    schema = arrow_schema(EpisodeRecord, sorted(records[0].feature_sha256))
    own = to_table(records, schema)
    for field in schema:
        if field.name not in _LEROBOTS:
            table = table.append_column(field, own[field.name])
    for path in paths:
        path.unlink()
    _write_table(paths[0], table)
    lean = [name for name in table.column_names if not name.startswith("stats/")]
    _write_table(root / RECORDS_PATH, table.select(lean))


def _write_table(path: Path, table: pa.Table) -> None:
    """Write a table that is read whole: of over a hundred columns, what skips rows is a burden.

    Most of it are SHA-256 sums, no two the same, to which a dictionary would only add numbers. It
    is written once and fetched with the first buffer, so it is compressed as well as can be.
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
    """Sort the features: LeRobot writes them in the order of a set, which differs between runs."""
    statistics = json.loads(path.read_text(encoding="utf-8"))
    text = json.dumps(statistics, indent=4, sort_keys=True, allow_nan=False)
    write_text(path, text + "\n")
