"""The manifest files: their columns, and how rows are found again by episode id."""

from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.constants import FORMAT_VERSION, MANIFEST_JSON, MANIFEST_PARQUET
from robomme_interference_data.errors import FormatError, UnknownNameError, nearest
from robomme_interference_data.files import Files, read_json
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema import BufferManifest, QueryFrame, SessionEntry

__all__ = ["QUERY_TYPE", "SCHEMA", "SESSION_TYPE", "ManifestReader"]

SESSION_TYPE = pa.struct(
    [
        pa.field("role", pa.string()),
        pa.field("family", pa.string()),
        pa.field("source", pa.string()),
        pa.field("dataset", pa.string()),
        pa.field("revision", pa.string()),
        pa.field("episode_index", pa.int64()),
        pa.field("start", pa.int32()),
        pa.field("stop", pa.int32()),
        pa.field("repeat", pa.int32()),
        pa.field("sha256", pa.string()),
    ]
)

QUERY_TYPE = pa.struct(
    [
        pa.field("dataset", pa.string()),
        pa.field("revision", pa.string()),
        pa.field("episode_index", pa.int64()),
        pa.field("frame", pa.int32()),
    ]
)

SCHEMA = pa.schema(
    [
        pa.field("episode_id", pa.string()),
        pa.field("family", pa.string()),
        pa.field("split", pa.string()),
        pa.field("index", pa.int64()),
        pa.field("k", pa.int32()),
        pa.field("condition", pa.string()),
        pa.field("goals", pa.list_(pa.string())),
        pa.field("seed", pa.int64()),
        pa.field("difficulty", pa.string()),
        pa.field("simulator", pa.string()),
        pa.field("exact", pa.bool_()),
        pa.field("lesson_frames", pa.int32()),
        pa.field("history_frames", pa.int32()),
        pa.field("lesson_share", pa.float64()),
        pa.field("query", QUERY_TYPE),
        pa.field("sessions", pa.list_(SESSION_TYPE)),
    ]
)


class ManifestReader:
    """The buffers of a split.

    Args:
        files: The split's `manifests` folder.

    Raises:
        MissingFileError: `manifest.json` is missing.
        FormatError: It is of an unknown version.
    """

    def __init__(self, files: Files):
        self.files = files
        self.header: dict[str, Any] = read_json(files.path(MANIFEST_JSON))
        if self.header.get("format_version") != FORMAT_VERSION:
            raise FormatError(
                f"{files.describe()} has format version {self.header.get('format_version')!r}; "
                f"this package reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or build the "
                "manifests again.",
            )

    @cached_property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        column = self._parquet.read(columns=["episode_id"])["episode_id"]
        return tuple(sorted(map(EpisodeId.parse, column.unique().to_pylist())))

    @property
    def k_values(self) -> tuple[int, ...]:
        """Numbers of distractor sessions that were planned, ascending."""
        return tuple(self.header["k"])

    def get(self, episode: EpisodeId, k: int) -> BufferManifest:
        """Return the manifest of one buffer.

        Raises:
            UnknownNameError: The split does not have this episode or this k.
        """
        found = list(self.select([("episode_id", "==", str(episode)), ("k", "==", k)]))
        if found:
            return found[0]
        where = self.files.describe()
        families = {known.family for known in self.episode_ids}
        if episode.family not in families:
            raise UnknownNameError(
                f"family {episode.family!r} is not in {where}", nearest(episode.family, families)
            )
        if episode not in self.episode_ids:
            raise UnknownNameError(
                f"{episode} is not in {where}", nearest(str(episode), map(str, self.episode_ids))
            )
        raise UnknownNameError(
            f"k={k} is not in {where}",
            f"Planned there: {', '.join(map(str, self.k_values))}. For another k, run "
            f"robomme-interference build manifests … --k {k}",
        )

    def select(self, filters: list[tuple[str, str, Any]]) -> Iterator[BufferManifest]:
        """Yield the manifests that pass all filters, in file order.

        Args:
            filters: Conditions `(column, operator, value)` as of `pyarrow.parquet.read_table`;
                an empty list selects all.
        """
        return map(_manifest, self.rows(filters))

    def rows(self, filters: list[tuple[str, str, Any]] | None = None) -> Iterator[dict[str, Any]]:
        """Yield the rows that pass all filters as plain values, in file order; see `select`."""
        for batch in self._batches(filters or []):
            yield from batch.to_pylist()

    @cached_property
    def _parquet(self) -> pq.ParquetFile:
        path = self.files.path(MANIFEST_PARQUET)
        try:
            file = pq.ParquetFile(path)
        except (pa.ArrowException, OSError) as error:
            raise FormatError(
                f"{path} is not a parquet file: {error}", "Build the manifests again."
            ) from None
        if not file.schema_arrow.equals(SCHEMA):
            missing = [name for name in SCHEMA.names if name not in file.schema_arrow.names]
            raise FormatError(
                f"{path} does not have the columns of format version {FORMAT_VERSION}"
                + (f": {', '.join(missing)} missing" if missing else ""),
                "Build the manifests again.",
            )
        return file

    def _batches(self, filters: list[tuple[str, str, Any]]) -> Iterable[pa.RecordBatch]:
        if not filters:
            return self._parquet.iter_batches(batch_size=1024)
        self._parquet  # noqa: B018 - checks the file first
        table = pq.read_table(self.files.path(MANIFEST_PARQUET), filters=filters)
        return table.to_batches(max_chunksize=1024)


def _manifest(row: dict[str, Any]) -> BufferManifest:
    return BufferManifest(
        episode_id=EpisodeId(row["family"], row["split"], row["index"]),
        k=row["k"],
        goals=tuple(row["goals"]),
        seed=row["seed"],
        difficulty=row["difficulty"],
        simulator=row["simulator"],
        exact=row["exact"],
        lesson_frames=row["lesson_frames"],
        history_frames=row["history_frames"],
        lesson_share=row["lesson_share"],
        query=QueryFrame(**row["query"]),
        sessions=tuple(
            SessionEntry(**{**session, "source": EpisodeId.parse(session["source"])})
            for session in row["sessions"]
        ),
    )
