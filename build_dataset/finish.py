"""Give a dataset that LeRobot wrote our columns, identity and report, and check its videos.

LeRobot 0.6 offers no way to hand per-episode columns to its writer, but reads any that stand in
`meta/episodes`: `LeRobotDatasetMetadata.filter_episodes` can select by them. So they are added
there, not in a file of their own. LeRobot's tools that merge datasets or change their features and
tasks carry them along; those that delete episodes or split a dataset drop them, and refuse the
lossless codec.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import pyarrow as pa
import pyarrow.parquet as pq

from robomme_interference_data.build_dataset.encode import Codec
from robomme_interference_data.build_dataset.plan import Plan, PlannedEpisode
from robomme_interference_data.build_dataset.stage import StagedEpisode
from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DISTRACTORS,
    EPISODES_DIR,
    FORMAT_VERSION,
    IDENTITY_PATH,
    REPORT_PATH,
    STATS_PATH,
    UNIT_FRAMES,
    UNIT_STRIDE,
)
from robomme_interference_data.digest import combine
from robomme_interference_data.errors import BuildError
from robomme_interference_data.files import canonical_json, read_json, write_json

__all__ = ["columns_of", "finish_dataset", "revision_of"]

_ROW_GROUP = 256
"""Rows in a row group of meta/episodes: small, so that few bytes find one episode."""

Episodes = Sequence[tuple[PlannedEpisode, StagedEpisode]]

_OWN_COLUMNS = (
    pa.field("episode_id", pa.string()),
    pa.field("family", pa.string()),
    pa.field("split", pa.string()),
    pa.field("source_episode", pa.int64()),
    pa.field("goals", pa.list_(pa.string())),
    pa.field("seed", pa.int64()),
    pa.field("difficulty", pa.string()),
    pa.field("simulator", pa.string()),
    pa.field("raw_length", pa.int64()),
    pa.field("exec_start_idx", pa.int64()),
    pa.field("exact", pa.bool_()),
    pa.field("sha256", pa.string()),
    pa.field("lesson_sha256", pa.string()),
)


def columns_of(planned: PlannedEpisode, staged: StagedEpisode, codec: Codec) -> dict[str, Any]:
    """Return our columns of an episode, by name."""
    episode = planned.episode
    lesson = staged.lesson_feature_sha256
    return {
        "episode_id": str(episode.id),
        "family": episode.id.family,
        "split": episode.id.split,
        "source_episode": episode.id.index,
        "goals": list(episode.goals),
        "seed": episode.seed,
        "difficulty": episode.difficulty,
        "simulator": episode.simulator,
        "raw_length": episode.raw_length,
        "exec_start_idx": planned.exec_start_idx,
        "exact": episode.exact and codec.exact,
        "sha256": combine(staged.feature_sha256),
        "lesson_sha256": combine(lesson) if lesson else None,
        **{f"sha256/{name}": digest for name, digest in staged.feature_sha256.items()},
        **{f"lesson_sha256/{name}": digest for name, digest in lesson.items()},
    }


def revision_of(rows: Sequence[dict[str, Any]]) -> str:
    """Return the identity of a dataset's content: SHA-256 over our columns, row by row."""
    digest = hashlib.sha256()
    for row in rows:
        digest.update(canonical_json(row).encode() + b"\n")
    return digest.hexdigest()


def finish_dataset(
    root: Path,
    name: str,
    version: str,
    plan: Plan,
    episodes: Episodes,
    codec: Codec,
    provenance: Sequence[dict[str, Any]],
) -> None:
    """Complete a dataset that LeRobot's writer has finished.

    Raises:
        BuildError: A video in the dataset is not the staged one, packet by packet.
    """
    rows = [columns_of(planned, staged, codec) for planned, staged in episodes]
    table = _add_columns(root, rows)
    _sort_statistics(root / STATS_PATH)
    _check_videos(root, table, episodes)
    cameras = sorted(
        key.removeprefix(CAMERA_PREFIX)
        for key in episodes[0][1].feature_sha256
        if key.startswith(CAMERA_PREFIX)
    )
    counts = {
        "episodes": len(rows),
        "frames": sum(staged.length for _, staged in episodes),
        "families": dict(Counter(row["family"] for row in rows)),
    }
    unit = {"frames": UNIT_FRAMES, "stride": UNIT_STRIDE} if plan.kind == DISTRACTORS else None
    write_json(
        root / IDENTITY_PATH,
        {
            "format_version": FORMAT_VERSION,
            "kind": plan.kind,
            "name": name,
            "version": version,
            "revision": revision_of(rows),
            "exact": all(row["exact"] for row in rows),
            "codec": codec.name,
            "cameras": cameras,
            "unit": unit,
            "simulators": sorted({row["simulator"] or "" for row in rows} - {""}),
            "sources": sorted(provenance, key=canonical_json),
            "counts": counts,
        },
    )
    write_json(
        root / REPORT_PATH,
        {
            "format_version": FORMAT_VERSION,
            "kind": plan.kind,
            "counts": {**counts, "skipped": len(plan.skipped)},
            "skipped": [
                {"episode_id": item.episode_id, "raw_length": item.raw_length, "why": item.reason}
                for item in plan.skipped
            ],
        },
    )


def _add_columns(root: Path, rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Rewrite meta/episodes as one file with our columns after LeRobot's; return the table."""
    folder = root / EPISODES_DIR
    paths = sorted(folder.rglob("*.parquet"))
    table = pa.concat_tables([pq.read_table(path) for path in paths]).combine_chunks()
    for name in ("meta/episodes/chunk_index", "meta/episodes/file_index"):
        place = table.schema.get_field_index(name)
        table = table.set_column(place, name, pa.array([0] * len(rows), pa.int64()))
    hashes = [
        pa.field(name, pa.string())
        for name in rows[0]
        if name.startswith(("sha256/", "lesson_sha256/"))
    ]
    for field in (*_OWN_COLUMNS, *hashes):
        table = table.append_column(field, pa.array([row[field.name] for row in rows], field.type))
    for path in paths:
        path.unlink()
    pq.write_table(table, paths[0], row_group_size=_ROW_GROUP, compression="zstd")
    return table


def _sort_statistics(path: Path) -> None:
    """Sort the features: LeRobot writes them in the order of a set, which differs between runs."""
    statistics = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(statistics, indent=4, sort_keys=True) + "\n", encoding="utf-8")


def _check_videos(root: Path, table: pa.Table, episodes: Episodes) -> None:
    """Hold the packets of every video file against the staged videos that it was made of.

    The staged videos were decoded and compared; equal packets decode to equal frames.
    """
    info = read_json(root / "meta/info.json")
    cameras = [name for name, f in info["features"].items() if f["dtype"] == "video"]
    for camera in cameras:
        key = f"videos/{camera}/"
        places: dict[tuple[int, int], list[int]] = {}
        chunks = table[key + "chunk_index"].to_pylist()
        files = table[key + "file_index"].to_pylist()
        starts = table[key + "from_timestamp"].to_pylist()
        for row, place in enumerate(zip(chunks, files, strict=True)):
            places.setdefault(place, []).append(row)
        for (chunk, file), members in places.items():
            path = root / info["video_path"].format(
                video_key=camera, chunk_index=chunk, file_index=file
            )
            found = _packets(path, info["fps"])
            expected = []
            for row in members:
                _planned, staged = episodes[row]
                first = round(starts[row] * info["fps"])
                own = _packets(staged.video(camera.removeprefix(CAMERA_PREFIX)), info["fps"])
                expected += [(first + number, digest) for number, digest in own]
            if sorted(found) != sorted(expected):
                ids = ", ".join(str(episodes[row][0].episode.id) for row in members[:3])
                raise BuildError(
                    f"{path.name} of {camera} (with {ids}, …) does not hold the staged videos",
                    "Please report this with the versions that robomme-interference doctor prints.",
                )


def _packets(path: Path, fps: int) -> list[tuple[int, bytes]]:
    """Return frame number and digest of every packet of a video."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return [
            (round(float(packet.pts * stream.time_base) * fps), hashlib.sha256(packet).digest())
            for packet in container.demux(stream)
            if packet.pts is not None
        ]
