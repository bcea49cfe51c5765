"""Compare the data of a buffer with the recorded SHA-256."""

from collections.abc import Callable, Mapping

from robomme_interference_data.errors import HashMismatchError
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.storage.arrays import combine

from .dataset import Dataset
from .query import Query


def verify_buffer(
    manifest: BufferManifest,
    query: Query,
    datasets: Mapping[str, Dataset],
    check_rules: Callable[[BufferManifest], None] | None,
) -> None:
    """Decode a buffer and its first live observation, and compare them with what is recorded.

    Raises:
        HashMismatchError: Records, frames or states differ.
    """
    # First the records, on which the rules depend, and whose digests the rest is compared with.
    sources = [datasets[entry.dataset] for entry in manifest.sessions]
    for dataset in dict.fromkeys([query.dataset, *sources]):
        dataset.check_records()
    if check_rules is not None:  # else no rule made the buffer
        check_rules(manifest)
    for entry in manifest.sessions:
        dataset, span = datasets[entry.dataset], (entry.start, entry.stop)
        what = f"{manifest}: {entry.role} {entry.source}"
        _check_span(what, dataset, entry.episode_index, span, entry.sha256)
    stored, recorded = query.first_frame, query.record.span_sha256
    span = stored.frame, stored.frame + 1
    sha256 = recorded.query if recorded else ""
    what = f"{manifest}: first live observation"
    _check_span(what, query.dataset, stored.episode_index, span, sha256)


def _check_span(
    what: str, dataset: Dataset, index: int, span: tuple[int, int], sha256: str
) -> None:
    [digests] = dataset.digests(index, [span])
    if combine(digests) == sha256:
        return
    recorded = dataset.record(index).digests(*span)
    differing = [name for name in digests if recorded and digests[name] != recorded.get(name)]
    columns = f": {', '.join(differing)}" if differing else ""
    raise HashMismatchError.damaged(
        f"{what} ({dataset.kind} episode {index}, frames {span[0]} to {span[1] - 1}) does not have "
        f"the recorded SHA-256{columns}"
    )
