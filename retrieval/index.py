"""Build the index of a dataset: embed every stored frame of a camera, and store it beside the data.

The index is built in a hidden folder, one episode at a time, so that an interrupted run resumes
there. It is renamed when it is complete.
"""

import shlex
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
    DISTRACTORS,
    EXECUTIONS,
    FORMAT_VERSION,
    IDENTITY_PATH,
    INDEX_HEADER,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import EmbeddingIndex, center_of, normalized
from robomme_interference_data.data.index_layout import (
    CENTER_FILE,
    INDEX_SUMS,
    EncoderRecord,
    IndexHeader,
    encoder_id,
    episode_file,
    index_folder,
)
from robomme_interference_data.errors import (
    BuildError,
    HubError,
    InterferenceError,
    InvalidOptionError,
    MissingFileError,
    first_line,
    named,
)
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Executor, Serial, Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.arrays import write_array
from robomme_interference_data.storage.files import (
    Files,
    LocalFiles,
    atomic_path,
    format_sums,
    sha256_file,
    write_json,
    write_text,
)
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.staging import replace_folder, staging_dir, staging_path
from robomme_interference_data.storage.text import canonical_json

from .encoders import Encoder, check_encoder, encoder_digest
from .segment import typical_cosine


@dataclass(frozen=True)
class IndexReport:
    """The index of one dataset.

    Attributes:
        folder: Folder of the index.
        embedded: Number of frames that this run embedded.
        header: Header of the index.
    """

    folder: str
    embedded: int
    header: IndexHeader


def datasets_to_index(folder: Path) -> list[Path]:
    """Return the datasets of a buffer set whose frames are embedded, or the one dataset itself.

    Raises:
        MissingFileError: The folder is neither.
    """
    paths = [folder / IDENTITY_PATH, *sorted(folder.glob(f"*/{IDENTITY_PATH}"))]
    roots = [path.parent.parent for path in paths if path.is_file()]
    # Executions belong to no history.
    roots = [root for root in roots if root == folder or root.name != EXECUTIONS]
    if not roots:
        raise MissingFileError(
            f"{folder} is neither a buffer set nor a dataset of this package",
            "Build one first:",
            shlex.join(["build", str(folder), "--source", "KIND:PATH"]),
        )
    return roots


def build_index(
    roots: Sequence[Path],
    encoder: Encoder,
    progress: WorkProgress,
    *,
    camera: str | None = None,
    threads: int = 1,
    force: bool = False,
    executor: Executor | None = None,
) -> list[IndexReport]:
    """Embed every stored frame of datasets, one index per dataset.

    An index depends on its dataset, the encoder and the camera only. The same data, encoder,
    device and batch give the same bytes, interrupted or not. A valid index is kept, whichever
    device computed it.

    Args:
        roots: Folders of the datasets.
        encoder: The encoder.
        progress: Shows the progress.
        camera: Camera to embed; None for the first.
        threads: Threads that decode and preprocess.
        force: Build all of it again.
        executor: Runs the episodes; None for this process.
    """
    if threads < 1:
        raise InvalidOptionError.expected("threads", threads, "1 or more")
    builders = [_IndexBuilder(root, encoder, camera) for root in roots]
    with ExitStack() as locks:
        for builder in builders:
            locks.enter_context(staging_dir(builder.folder))
        progress.start(encoder.name, sum(sum(builder.lengths) for builder in builders))
        reports = []
        for builder in builders:
            header, embedded = None if force else builder.existing(), 0
            if header is not None:
                progress.advance(header.frames, before=True)
            else:
                embedded = builder.embed(executor or Serial(), threads, progress, force=force)
                header = builder.write()
            reports.append(IndexReport(str(builder.folder), embedded, header))
        return reports


def look_on_hub(buffer_set: BufferSet, encoder: Encoder, camera: str) -> Iterator[str]:
    """Yield for each dataset on the Hub a message on whether it has embeddings by this encoder."""
    for name, recorded in buffer_set.header.datasets.items():
        files = buffer_set.dataset_files(name)
        if name == EXECUTIONS or not isinstance(files, HubFiles):
            continue
        try:
            index = EmbeddingIndex(files, recorded.revision, encoder.name, camera)
            check_encoder(index.header.encoder, encoder, index.remedy)
        except HubError as error:
            message = f"cannot check whether {files.describe()} has embeddings: {error.message}"
            yield "\n".join([message, *filter(None, [error.hint])])
        except InterferenceError as error:
            yield (
                f"retrieval will not find the {name}: {error.message}\n"
                "Ask the publisher for embeddings, or download the dataset and index it too:\n"
                f"  hf download {files.repo_id} --repo-type dataset --revision {files.commit} "
                f"--local-dir {buffer_set.location}/{name}"
            )
        else:
            yield f"{files.describe()} has embeddings by the same encoder"


@dataclass
class _EmbedTask:
    """Embeds an episode; each worker process opens its own dataset and encoder."""

    files: Files
    camera: str
    encoder: Encoder
    threads: int

    @cached_property
    def _dataset(self) -> Dataset:
        return Dataset(self.files)

    def __call__(self, task: int, worker: Worker) -> NDArray[np.float16]:
        """Return the features of an episode, `(T, D) float16`."""
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
            features += [self.encoder.features(future.result()) for future in waiting]
        with np.errstate(over="ignore"):  # too large values become infinite, which is an error
            return np.concatenate(features).astype(np.float16)


class _IndexBuilder:
    """Builds the index of one dataset."""

    def __init__(self, root: Path, encoder: Encoder, camera: str | None):
        self.dataset, self.encoder = Dataset(LocalFiles(root)), encoder
        self.units = self.dataset.kind == DISTRACTORS
        self.camera = self.dataset.camera(camera)
        self.lengths = [record.length for record in self.dataset.records()]
        self.computed = {"in": encoder.computed_in, "batch": encoder.batch}
        self.folder = root / index_folder(encoder.name, self.camera)
        # Features of other settings go to another folder, so that they are never mixed.
        made_of = canonical_json([encoder.fingerprint, self.computed, self.dataset.revision])
        self.made = staging_path(self.folder) / sha256(made_of.encode()).hexdigest()[:16]
        self.features = [self.made / episode_file(episode) for episode in range(len(self.lengths))]

    def existing(self) -> IndexHeader | None:
        """Return the header of the existing index, if it is valid."""
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
        """Compute missing features; return the number of embedded frames."""
        missing = []
        for episode, (path, length) in enumerate(zip(self.features, self.lengths, strict=True)):
            if path.is_file() and not force:
                progress.advance(length, before=True)
            else:
                missing.append(episode)
        task = _EmbedTask(self.dataset.files, self.camera, self.encoder, threads)
        for outcome in executor.run(task, missing):
            episode_id = self.dataset.record(outcome.task).episode_id
            if isinstance(outcome.error, InterferenceError):
                raise outcome.error
            if outcome.error is not None:
                message = f"{episode_id} cannot be embedded: {first_line(outcome.error)}"
                raise BuildError(message, "Fix the cause and run the same command again.")
            if not np.isfinite(outcome.value).all():
                raise BuildError(
                    f"encoder {self.encoder.name!r} returned NaN or infinity for {episode_id}",
                    "Its weights may be damaged, or its precision too low: try "
                    f"{named('device', 'cpu')}.",
                )
            with atomic_path(self.features[outcome.task]) as partial:
                write_array(partial, outcome.value)
            progress.advance(len(outcome.value), node=outcome.node)
        return sum(self.lengths[episode] for episode in missing)

    def write(self) -> IndexHeader:
        """Write the rest of the index, and rename it."""
        made, encoder, typical, center = self.made, self.encoder, None, None
        names = [episode_file(episode) for episode in range(len(self.lengths))]
        if self.units:
            if encoder.centered:
                center = center_of(map(np.load, self.features))
                write_array(made / CENTER_FILE, center)
            typical = typical_cosine(
                len(names), lambda episode: normalized(np.load(self.features[episode]), center)
            )
        written = names if center is None else [*names, CENTER_FILE]
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
