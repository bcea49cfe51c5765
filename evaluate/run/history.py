"""The history that a policy or model receives: its frames, and the columns about them."""

from collections.abc import Generator, Mapping, Sequence
from typing import Any

import numpy as np

from robomme_interference_data.constants import STATE
from robomme_interference_data.data.buffer import Buffer, Chunk
from robomme_interference_data.data.dataset import Dataset, camera_feature
from robomme_interference_data.errors import HashMismatchError
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.other_states import OtherStates
from robomme_interference_data.schema.sampling import (
    Memory,
    even_sample,
    evidence_kept,
    lesson_frames,
    lesson_share,
)
from robomme_interference_data.storage.arrays import FeatureDigests, combine


class HistoryReader:
    """Reads frames of buffers of a buffer set, given its datasets.

    It compares each session, once, with its recorded SHA-256 while it decodes it.
    """

    def __init__(self, datasets: Mapping[str, Dataset]):
        self._datasets = datasets
        self._verified: set[tuple[SessionEntry, tuple[str, ...]]] = set()

    def stream(
        self,
        buffer: Buffer,
        size: int,
        cameras: Sequence[str],
        indices: Sequence[int],
        other_states: OtherStates = "refuse",
    ) -> Generator[Chunk]:
        """Decode frames of a buffer, by their indices, in chunks of at most `size` frames.

        `other_states` is as for `Buffer.stream`.

        Raises `HashMismatchError` if states or frames of a session are not the recorded ones. So
        sessions that were not compared yet are decoded whole, even for a few of their frames.
        """
        frames = np.asarray(indices, np.int64)
        unverified = {}  # sessions to compare, with the digests of what was decoded so far
        for number, session in enumerate(buffer.sessions):
            key = session.entry, tuple(sorted(cameras))
            read = ((frames >= session.start) & (frames < session.stop)).any()
            if read and key not in self._verified:
                digests = FeatureDigests()
                # As they were recorded, whatever the policy gets of them.
                states = buffer.session_states(number)[:: session.entry.repeat]
                digests.update(STATE, states)
                unverified[key] = session, digests
        decoded = [frames]
        for session, _ in unverified.values():
            decoded.append(np.arange(session.start, session.stop))
        needed = np.unique(np.concatenate(decoded)).tolist()
        for chunk in buffer.stream(size, cameras, needed, other_states):
            for key in [*unverified]:
                session, digests = unverified[key]
                inside = (chunk.indices >= session.start) & (chunk.indices < session.stop)
                if not inside.any():
                    continue
                # Digests are over stored frames; a held frame stands in the buffer several times.
                stored = inside & ((chunk.indices - session.start) % session.entry.repeat == 0)
                for camera in cameras:
                    images = chunk.frames[camera]
                    if not stored.all():  # indexing copies all pixels
                        images = images[stored]
                    digests.update(camera_feature(camera), images)
                if chunk.indices[-1] >= session.stop - 1:
                    self._compare(session.entry, digests.current())
                    self._verified.add(key)
                    del unverified[key]
            keep = np.isin(chunk.indices, frames)  # not those that are only compared
            if keep.all():
                yield chunk
            elif keep.any():
                kept = {name: values[keep] for name, values in chunk.frames.items()}
                yield Chunk(
                    chunk.indices[keep], kept, chunk.states[keep], chunk.session_index[keep]
                )

    def _compare(self, entry: SessionEntry, digests: dict[str, str]) -> None:
        """Compare digests by feature with those that records and manifest have of a session."""
        dataset, span = self._datasets[entry.dataset], (entry.start, entry.stop)
        recorded = dataset.record(entry.episode_index).digests(*span)
        if recorded is None:  # of a part that has no digests of its own
            [recorded] = dataset.digests(entry.episode_index, [span])
        wrong = [name for name, digest in digests.items() if recorded.get(name) != digest]
        if not wrong and combine(recorded) == entry.sha256:
            return
        features = wrong or [*digests]
        files = dataset.files_of(entry.episode_index, [name for name in features if name != STATE])
        files = files if STATE in features else files[1:]  # the first one holds the vectors
        raise HashMismatchError.damaged(
            f"{', '.join(files)} in {dataset.files.describe()}: {', '.join(features)} of the "
            f"{entry.role} {entry.source} differ from the SHA-256 that the buffer set records"
        )


def history_columns(
    buffer: Buffer, received: Sequence[int], memory: Memory | None, *, retrieved: bool
) -> dict[str, Any]:
    """Return the columns about the frames of a buffer that a policy or model received.

    Args:
        buffer: The history.
        received: The frames, as ascending indices.
        memory: What of them the memory keeps; None if unknown.
        retrieved: Whether a retrieval step chose them; if not, the policy received all.
    """
    share = lesson_share(buffer.sessions, received) if received else None
    columns: dict[str, Any] = {
        "history_frames": len(received),
        "lesson_frames": lesson_frames(buffer.sessions, received),
        "lesson_share": share,
    }
    if retrieved and share is not None:
        columns |= _retrieval_columns(received, share)
    if memory is not None and buffer.evidence is not None:
        columns["evidence_kept"] = evidence_kept(buffer.evidence, memory.kept(received))
    return columns


def _retrieval_columns(chosen: Sequence[int], lesson_share: float) -> dict[str, Any]:
    """Return `RetrievalColumns`, given the chosen frames and the lesson's share of their sample.

    `chosen` are ascending indices of a buffer's frames, at least one.
    """
    frames = len(even_sample(len(chosen)))
    filler = (frames - 1 - round(lesson_share * frames)) / frames
    return {
        "retrieval_start": chosen[0],
        "retrieval_stop": chosen[-1] + 1,
        "retrieval_selected_lesson_fraction": lesson_share,
        "retrieval_selected_filler_fraction": filler,
        "retrieval_selected_query_fraction": 1 / frames,
    }
