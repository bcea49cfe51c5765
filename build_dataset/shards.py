"""Shards of a build: episodes that independent machines record, and what they are merged into.

The folder of a shard has `shard.json`, which says what the whole build is, and a folder of staged
episodes for each dataset, `staged/DATASET`. While shards are merged, the folder of the buffer set
has a `shard.json` too, so that a merge that was interrupted resumes, and no other goes on there.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Self

from robomme_interference_data.constants import FORMAT_VERSION, SHARD_PATH
from robomme_interference_data.errors import (
    BuildError,
    BusyError,
    FormatError,
    InvalidOptionError,
    counted,
)
from robomme_interference_data.runtime.executor import WorkersConfig
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.settings import changed_settings
from robomme_interference_data.schema.shard import Shard
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.staging import file_lock
from robomme_interference_data.storage.text import canonical_json, read_header

from .alike import unequal
from .config import BuffersConfig, BuildConfig
from .dataset.plan import DatasetPlan
from .dataset.same_simulators import facts_of
from .dataset.staged import read_staged, staged_name
from .plan.parts import BuildPlan

_OF_A_MACHINE = (
    "buffer_set",
    "shard",
    "time_limit_s",
    *(field.name for field in fields(WorkersConfig)),
)
"""Settings that do not change what is built."""


@dataclass(frozen=True)
class ShardRecord:
    """`shard.json`."""

    format_version: Annotated[int, "Of the file."]
    shard: Annotated[str, "Which part of the build, such as `2/8`; `1/1` while shards are merged."]
    build: Annotated[dict[str, Any], "The settings of the build that are not defaults."]
    buffers: Annotated[dict[str, Any], "Those of the buffers to plan."]
    sources: Annotated[tuple[dict[str, Any], ...], "What the datasets record about each source."]
    finished: Annotated[bool, "Whether all of its episodes are recorded."] = False

    @classmethod
    def of(cls, config: BuildConfig, request: BuffersConfig, plan: BuildPlan) -> Self:
        """Return the record of a shard whose build begins."""
        sources = {
            canonical_json(source): source
            for dataset in plan.datasets.values()
            for source in dataset.provenances
        }
        return cls(
            FORMAT_VERSION,
            config.shard,
            _changed(config),
            _changed(request),
            tuple(source for _, source in sorted(sources.items())),
        )

    @property
    def number(self) -> Shard:
        """Which part of the build it is."""
        return Shard.parse(self.shard)

    def differences(self, mine: str, other: "ShardRecord", theirs: str) -> list[str]:
        """Return how the builds differ, a clause each, given the names of both."""
        return unequal((mine, self._facts()), (theirs, other._facts()))

    def configs(self, out: Path) -> tuple[BuildConfig, BuffersConfig]:
        """Return the settings of the whole build in a folder."""
        try:
            config = BuildConfig(buffer_set=out, **_settings(self.build))
            return config, BuffersConfig(**_settings(self.buffers))
        except TypeError as error:  # settings of another version of this package
            raise FormatError.damaged(SHARD_PATH, str(error)) from None

    def _facts(self) -> dict[str, Any]:
        facts = {**self.build, **self.buffers}
        for source in self.sources:
            facts |= {
                f"{source['kind']}'s {name}": value for name, value in facts_of(source).items()
            }
        return facts


def _changed(config: BuildConfig | BuffersConfig) -> dict[str, Any]:
    values = asdict(config)
    changed = {name: values[name] for name in changed_settings(config, _OF_A_MACHINE)}
    # As JSON has them, so that what is written equals what is read.
    return {name: [*value] if type(value) is tuple else value for name, value in changed.items()}


def _settings(recorded: dict[str, Any]) -> dict[str, Any]:
    return {
        name: tuple(value) if isinstance(value, list) else value for name, value in recorded.items()
    }


def staged_folder(folder: Path, kind: str) -> Path:
    """Return where a shard's folder has the staged episodes of a dataset."""
    return folder / "staged" / kind


def check_is_no_shard(root: Path) -> None:
    """Check that a folder, in which a whole buffer set is to be built, is not that of a shard."""
    if (root / SHARD_PATH).is_file():
        shard = _read(root).shard
        raise BuildError(
            f"{root} holds shard {shard} of a build, not a buffer set",
            f"Resume it with the option --shard {shard}, merge it with the others, or choose "
            "another folder.",
        )


@contextmanager
def recording(config: BuildConfig, request: BuffersConfig, plan: BuildPlan) -> Iterator[None]:
    """Hold the folder of a shard while its episodes are recorded, and record that they all are."""
    root, record = config.buffer_set, ShardRecord.of(config, request, plan)
    claim(root, record)
    busy = BusyError(f"another process is building {root}", "Wait for it to end, or stop it.")
    with file_lock(root / ".lock", busy):
        yield
        write_json(root / SHARD_PATH, to_dict(replace(record, finished=True)))


def claim(root: Path, record: ShardRecord) -> None:
    """Record in a folder which shard it is for.

    Raises:
        BuildError: It holds something else, or another shard.
    """
    if (root / SHARD_PATH).is_file():
        found = _read(root)
        differ = found.differences("it", record, "this one")
        if found.shard != record.shard:
            differ.insert(0, f"shard: {found.shard} in it, {record.shard} in this one")
        if differ:
            raise BuildError(
                f"{root} is of another build: {'; '.join(differ)}",
                "Choose a new folder, or repeat the command that began it.",
            )
    elif root.exists() and any(root.iterdir()):
        raise BuildError(f"{root} already exists", "Give a new folder.")
    else:
        root.mkdir(parents=True, exist_ok=True)
        write_json(root / SHARD_PATH, to_dict(record))


def release(root: Path) -> None:
    """Remove the record from a buffer set into which all shards are merged."""
    (root / SHARD_PATH).unlink()


def read_shards(folders: Sequence[Path]) -> ShardRecord:
    """Return the record of the build that shards make together, after checking that they do.

    Raises:
        BuildError: A folder holds no shard or an unfinished one, they are of different builds, or
            a shard is missing or given twice.
    """
    records = [(folder, _read(folder)) for folder in folders]
    first, whole = records[0]
    given: dict[Shard, Path] = {}
    for folder, record in records:
        if not record.finished:
            raise BuildError(
                f"shard {record.shard} in {folder} is not finished",
                "Run the command that began it again, to resume it.",
            )
        differ = whole.differences(str(first), record, str(folder))
        if record.number.of != whole.number.of:
            differ.insert(0, f"shard: {whole.shard} in {first}, {record.shard} in {folder}")
        if differ:
            raise BuildError(
                f"the shards are of different builds: {'; '.join(differ)}",
                "Merge shards of one command, which differ in --shard and the folder alone.",
            )
        if record.number in given:
            raise BuildError(
                f"shard {record.shard} is given twice: {given[record.number]} and {folder}",
                "Leave out one of them.",
            )
        given[record.number] = folder
    every = {Shard(number, whole.number.of) for number in range(1, whole.number.of + 1)}
    if missing := sorted(every - given.keys()):
        raise BuildError(
            f"missing: shard {', '.join(map(str, missing))}",
            "Give all shards: the buffers are planned from all of their episodes.",
        )
    return replace(whole, shard=str(Shard(1, 1)), finished=False)


def check_all_staged(plan: DatasetPlan, folders: Sequence[Path]) -> None:
    """Check that every episode of a dataset is staged in one of the folders."""
    missing = [
        str(planned.episode.id)
        for planned in plan.episodes
        if not any(read_staged(folder / staged_name(plan, planned)) for folder in folders)
    ]
    if missing:
        raise BuildError(
            f"no shard has {missing[0]}"
            + (f" and {counted(len(missing) - 1, 'more episode')}" if len(missing) > 1 else "")
            + f" of the {plan.kind}",
            "The source here has other episodes than where the shards were built.",
        )


def _read(folder: Path) -> ShardRecord:
    path = folder / SHARD_PATH
    if not path.is_file():
        raise InvalidOptionError(
            f"{folder} holds no shard of a build",
            "Build one: robomme-interference build FOLDER --source SOURCE --shard 1/2",
        )
    return read_header(path, ShardRecord)
