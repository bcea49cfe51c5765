"""Make the index of a dataset: embed every stored frame of a camera, and keep it beside the data.

It is made in a hidden folder beside its place, an episode at a time, so that an interrupted run
goes on from there. The index gets its name when it is whole.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DISTRACTORS,
    FORMAT_VERSION,
    INDEX_HEADER,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.buffer_set_index import normalised
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import (
    CENTRE_FILE,
    INDEX_SUMS,
    EmbeddingIndex,
    EncoderRecord,
    IndexHeader,
    centre_of,
    encoder_id,
    episode_file,
    index_folder,
)
from robomme_interference_data.errors import (
    BuildError,
    HubError,
    InterferenceError,
    InvalidOptionError,
    first_line,
)
from robomme_interference_data.runtime.executor import Executor, Serial, Worker
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.arrays import write_array
from robomme_interference_data.storage.files import (
    Files,
    LocalFiles,
    atomic_path,
    canonical_json,
    format_sums,
    sha256_file,
    write_json,
    write_text,
)
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.staging import replace_folder, staging_dir, staging_path

from .encoders import Encoder, check_encoder, encoder_digest
from .segment import typical_cosine


@dataclass(frozen=True)
class IndexReport:
    """What was done for one dataset.

    Attributes:
        folder: Where the index lies.
        embedded: Frames that were embedded now; the others were there already.
        header: What it is.
    """

    folder: str
    embedded: int
    header: IndexHeader


def build_index(
    roots: Sequence[Path],
    encoder: Encoder,
    progress: WorkProgress,
    *,
    camera: str = "front",
    threads: int = 1,
    force: bool = False,
    executor: Executor | None = None,
) -> list[IndexReport]:
    """Embed every stored frame of datasets, each by itself.

    An index depends on its dataset, the encoder and the camera alone. The same data, encoder,
    device and batch give the same bytes, interrupted or not. An index that is there and right is
    left as it is, on whatever device it was computed.

    Args:
        roots: Folders of the datasets.
        encoder: What embeds.
        progress: Shows how far it is.
        camera: Camera to embed, with or without `observation.images.`.
        threads: Threads that decode and preprocess beside the encoder.
        force: Make all of it again.
        executor: Who embeds the episodes; None for this process.
    """
    if threads < 1:
        raise InvalidOptionError.expected("threads", threads, "1 or more")
    works = [_Work(root, encoder, camera) for root in roots]
    with ExitStack() as held:
        for work in works:
            held.enter_context(staging_dir(work.folder))
        progress.start(encoder.name, sum(sum(work.lengths) for work in works))
        reports = []
        for work in works:
            header, embedded = None if force else work.found(), 0
            if header is not None:
                progress.advance(header.frames, before=True)
            else:
                embedded = work.embed(executor or Serial(), threads, progress, force=force)
                header = work.write()
            reports.append(IndexReport(str(work.folder), embedded, header))
        return reports


def look_on_hub(buffer_set: BufferSet, encoder: Encoder, camera: str = "front") -> Iterator[str]:
    """Say of each dataset of a buffer set that lies on the Hub whether retrieval finds embeddings there.

    Args:
        buffer_set: The buffer set.
        encoder: What embedded its other datasets.
        camera: Camera, with or without `observation.images.`.
    """
    for name, recorded in buffer_set.header.datasets.items():
        files = buffer_set.dataset_files(name)
        if not isinstance(files, HubFiles):
            continue
        try:
            index = EmbeddingIndex(files, recorded.revision, encoder.name, camera)
            check_encoder(index.header.encoder, encoder, index.remedy)
        except HubError as error:
            told = f"whether {files.describe()} has embeddings cannot be told: {error.message}"
            yield "\n".join([told, *filter(None, [error.hint])])
        except InterferenceError as error:
            yield (
                f"retrieval will not find the {name}: {error.message}\n"
                "Ask their publisher for embeddings, or fetch them and embed their frames too:\n"
                f"  hf download {files.repo_id} --repo-type dataset --revision {files.commit} "
                f"--local-dir {buffer_set.location}/{name}"
            )
        else:
            yield f"{files.describe()} has embeddings by the same encoder: retrieval finds them"


@dataclass
class _EmbedTask:
    """Embeds an episode; a worker that is another process opens dataset and encoder of its own."""

    files: Files
    camera: str
    encoder: Encoder
    threads: int

    @cached_property
    def _dataset(self) -> Dataset:
        return Dataset(self.files)

    def __call__(self, task: int, worker: Worker) -> NDArray[np.float16]:
        """Return the features of an episode as they are kept, `(T, D) float16`."""
        dataset, batch = self._dataset, self.encoder.batch
        length = dataset.record(task).length
        features, waiting = [], deque[Future[Any]]()

        def prepare(start: int) -> Any:
            shape = min(batch, length - start), *dataset.shape(self.camera)
            images = np.empty(shape, np.uint8)
            dataset.read_frames(task, self.camera, start, images)
            return self.encoder.prepare(images)

        with ThreadPoolExecutor(self.threads) as pool:
            for start in range(0, length, batch):
                waiting.append(pool.submit(prepare, start))
                if len(waiting) > 2 * self.threads:  # prepared images are large
                    features.append(self.encoder.features(waiting.popleft().result()))
            features += [self.encoder.features(one.result()) for one in waiting]
        with np.errstate(over="ignore"):  # what is too large is no finite number
            return np.concatenate(features).astype(np.float16)


class _Work:
    """The index of one dataset, being made."""

    def __init__(self, root: Path, encoder: Encoder, camera: str):
        self.dataset, self.encoder = Dataset(LocalFiles(root)), encoder
        self.dataset.shape(camera)  # there is such a camera
        self.units = self.dataset.kind == DISTRACTORS
        self.camera = camera.removeprefix(CAMERA_PREFIX)
        self.lengths = [record.length for record in self.dataset.records()]
        self.computed = {"in": encoder.computed_in, "batch": encoder.batch}
        self.folder = root / index_folder(encoder.name, camera)
        self.hidden = staging_path(self.folder)
        # Features that were made otherwise have another place: they are never mixed.
        made_of = canonical_json([encoder.fingerprint, self.computed, self.dataset.revision])
        self.made = self.hidden / sha256(made_of.encode()).hexdigest()[:16]
        self.features = [self.made / episode_file(episode) for episode in range(len(self.lengths))]

    def found(self) -> IndexHeader | None:
        """Return the header of the index that is there, if it is right."""
        files, revision = self.dataset.files, self.dataset.revision
        try:
            index = EmbeddingIndex(files, revision, self.encoder.name, self.camera)
            check_encoder(index.header.encoder, self.encoder, index.remedy)
            index.check(dict(enumerate(self.lengths)), units=self.units)
        except InterferenceError:
            return None
        return index.header

    def embed(
        self, executor: Executor, threads: int, progress: WorkProgress, *, force: bool
    ) -> int:
        """Make the features that are missing; return the number of embedded frames."""
        missing = []
        for episode, (path, length) in enumerate(zip(self.features, self.lengths, strict=True)):
            if path.is_file() and not force:
                progress.advance(length, before=True)
            else:
                missing.append(episode)
        task = _EmbedTask(self.dataset.files, self.camera, self.encoder, threads)
        for outcome in executor.run(task, missing):
            about = self.dataset.record(outcome.task).episode_id
            if isinstance(outcome.error, InterferenceError):
                raise outcome.error
            if outcome.error is not None:
                what = f"{about} cannot be embedded: {first_line(outcome.error)}"
                raise BuildError(what, "Finished episodes are kept: fix it, and run it again.")
            if not np.isfinite(outcome.value).all():
                raise BuildError(
                    f"encoder {self.encoder.name!r} gave values that are not finite for {about}",
                    'Its weights may be damaged, or its precision too low: try device="cpu".',
                )
            with atomic_path(self.features[outcome.task]) as partial:
                write_array(partial, outcome.value)
            progress.advance(len(outcome.value), node=outcome.node)
        return sum(self.lengths[episode] for episode in missing)

    def write(self) -> IndexHeader:
        """Write what belongs to the features, and give the index its name."""
        made, encoder, typical, centre = self.made, self.encoder, None, None
        names = [episode_file(episode) for episode in range(len(self.lengths))]
        if self.units:
            if encoder.centred:
                centre = centre_of(map(np.load, self.features))
                write_array(made / CENTRE_FILE, centre)
            typical = typical_cosine(
                len(names), lambda episode: normalised(np.load(self.features[episode]), centre)
            )
        written = names if centre is None else [*names, CENTRE_FILE]
        write_text(made / INDEX_SUMS, format_sums(made, written))
        header = IndexHeader(
            format_version=FORMAT_VERSION,
            encoder=EncoderRecord(
                encoder_id(encoder.name), encoder.fingerprint, encoder_digest(encoder)
            ),
            computed=self.computed,
            camera=self.camera,
            revision=self.dataset.revision,
            frames=sum(self.lengths),
            size=np.load(self.features[0]).shape[1],
            typical_cosine=typical,
            sums=sha256_file(made / INDEX_SUMS),
        )
        header = replace(header, sha256=header.digest())
        write_json(made / INDEX_HEADER, to_dict(header))
        replace_folder(made, self.folder)
        return header
