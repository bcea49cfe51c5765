"""The manifest files: their columns, and how rows are found again by episode id."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data import parquet
from robomme_interference_data.constants import FORMAT_VERSION, MANIFEST_JSON, MANIFEST_PARQUET
from robomme_interference_data.errors import FormatError, UnknownNameError, nearest
from robomme_interference_data.files import Files, check_names, read_json
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


_KEYS = ("episode_id", "k")
_HEADER_KEYS = ("rule_version", "seed", "k", "position_limit", "datasets", "counts", "files")


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
        self._metadata: pq.FileMetaData | None = None
        path = files.path(MANIFEST_JSON)
        self.header = read_json(path)
        if self.header.get("format_version") != FORMAT_VERSION:
            raise FormatError(
                f"{files.describe()} has format version {self.header.get('format_version')!r}; "
                f"this package reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or build the "
                "manifests again.",
            )
        check_names(path, self.header, _HEADER_KEYS)

    @cached_property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        return tuple(sorted(map(EpisodeId.parse, self.values("episode_id"))))

    @property
    def k_values(self) -> tuple[int, ...]:
        """Numbers of distractor sessions that were planned, ascending."""
        return tuple(self.header["k"])

    def values(self, column: str) -> list[Any]:
        """Return the distinct values of a column."""
        with self._opened() as file:
            return list(file.read(columns=[column])[column].unique().to_pylist())

    def get(self, episode: EpisodeId, k: int) -> BufferManifest:
        """Return the manifest of one buffer.

        Raises:
            UnknownNameError: The split does not have this episode or this k.
        """
        if k in self.k_values:
            for manifest in self.select({"episode_id": str(episode), "k": int(k)}):
                return manifest
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
            f"k={k!r} is not in {where}",
            f"Planned there: {', '.join(map(str, self.k_values))}. For another k, run "
            f"robomme-interference build manifests … --k {k}",
        )

    def select(self, equal: Mapping[str, Any]) -> Iterator[BufferManifest]:
        """Yield the manifests with the given values, in file order.

        Args:
            equal: Column name to value; an empty mapping selects all.
        """
        return map(_manifest, self.rows(equal))

    def rows(self, equal: Mapping[str, Any] | None = None) -> Iterator[dict[str, Any]]:
        """Yield the rows with the given values as plain values, in file order; see `select`."""
        with self._opened() as file:
            keep = None
            if equal:
                known = equal.keys() <= set(_KEYS)
                columns = self._keys if known else file.read(columns=list(equal))
                keep = parquet.matching(columns, equal)
            for table in parquet.read_rows(file, None, keep):
                yield from table.to_pylist()

    @cached_property
    def _keys(self) -> pa.Table:
        """The columns by which single buffers are found; kept, as many may be asked for."""
        with self._opened() as file:
            return file.read(columns=list(_KEYS))

    @contextmanager
    def _opened(self) -> Iterator[pq.ParquetFile]:
        path = self.files.path(MANIFEST_PARQUET)
        with parquet.reading(path), pq.ParquetFile(path, metadata=self._metadata) as file:
            if self._metadata is None:
                self._check_columns(path, file.schema_arrow)
                self._metadata = file.metadata
            yield file

    def _check_columns(self, path: Path, schema: pa.Schema) -> None:
        if schema.equals(SCHEMA):
            return
        missing = [name for name in SCHEMA.names if name not in schema.names]
        raise FormatError(
            f"{path} does not have the columns of format version {FORMAT_VERSION}"
            + (f": {', '.join(missing)} missing" if missing else ""),
            "Build the manifests again.",
        )


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
