"""Commands that make splits: `build …`."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.constants import (
    DEFAULT_K,
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFESTS,
    POSITION_LIMIT,
)
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.progress import MESSAGES

if TYPE_CHECKING:
    from robomme_interference_data.build_dataset.build import Filters, Settings
    from robomme_interference_data.build_dataset.sources import Source

__all__ = ["app"]


app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Build datasets of demonstrations and distractor units, and manifests of buffers.",
    epilog="""Flow: record or download episodes, build both datasets and the manifests, verify.

```
robomme-interference build all --source robomme-h5:recordings/ --out my-split
robomme-interference verify my-split
robomme-interference show MoveCube/train/0 --split my-split --k 3 --out strip.png
```

`build all` is these three, with S=my-split:

```
robomme-interference build demonstrations --source robomme-h5:recordings/ --out $S/demonstrations
robomme-interference build distractors --source robomme-h5:recordings/ --out $S/distractors
robomme-interference build manifests --demonstrations $S/demonstrations \\
    --distractors $S/distractors --out $S/manifests --k 0 1 3 7 --seed 0
```
""",
)

Sources = Annotated[
    list[str],
    typer.Option(
        "--source",
        help="KIND:LOCATION, with kind robomme-h5, lerobot or frames, or the name of a simulator: "
        "tabletop, or, for demonstrations, robomme; may be given several times.",
    ),
]
Families = Annotated[
    str | None, typer.Option(help="Families to take, comma-separated; all by default.")
]
Episodes = Annotated[
    str | None, typer.Option(help="Episode numbers to take, such as 0-49 or 0,3,10-12.")
]
Cameras = Annotated[
    str | None, typer.Option(help="Cameras to store, such as front; all by default.")
]
CodecName = Annotated[
    str, typer.Option(help="av1-lossless (bit-exact) or lerobot-default (smaller, lossy).")
]
Version = Annotated[str, typer.Option(help="Version that the dataset carries.")]
Workers = Annotated[
    int, typer.Option(help="Processes that encode side by side.", show_default="all processors")
]
TimeLimit = Annotated[
    float,
    typer.Option(help="Seconds that one episode may take before it is tried once more."),
]
Columns = Annotated[
    str | None,
    typer.Option(help="lerobot sources: NAME=COLUMN,… where the dataset's columns differ."),
]
FamiliesFile = Annotated[
    Path | None, typer.Option(help="lerobot sources: file that names each episode's family.")
]
RoboMMEPython = Annotated[
    str | None,
    typer.Option(help="Source robomme: interpreter that has RoboMME.", envvar="ROBOMME_PYTHON"),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
K = Annotated[
    list[int] | None,
    typer.Option("--k", help="Numbers of distractor sessions.", show_default="0 1 3 7"),
]
Seed = Annotated[int, typer.Option(help="Seed of the draw.")]
Limit = Annotated[
    str,
    typer.Option(help="Positions that the systems hold for history and rollout, or none."),
]

_CPUS = os.cpu_count() or 1
_TIME_LIMIT = 1800.0


@app.command()
def demonstrations(
    source: Sources,
    out: Annotated[Path, typer.Option(help="Folder of the dataset; made by the build.")],
    families: Families = None,
    split: Annotated[str | None, typer.Option(help="Only train, val or test.")] = None,
    episodes: Episodes = None,
    cameras: Cameras = None,
    codec: CodecName = "av1-lossless",
    version: Version = "1.0.0",
    workers: Workers = _CPUS,
    time_limit: TimeLimit = _TIME_LIMIT,
    columns: Columns = None,
    families_file: FamiliesFile = None,
    robomme_python: RoboMMEPython = None,
    as_json: AsJson = False,
) -> None:
    """Build the query episodes' demonstrations, each with its first live observation at the end.

    Stopped with Ctrl-C, or killed, a build goes on where it was when the command is run again.
    """
    filters = (families, split, episodes)
    settings = (codec, cameras, version, workers, time_limit)
    opening = (columns, families_file, robomme_python)
    _build(DEMONSTRATIONS, source, out, filters, settings, opening, as_json=as_json)


@app.command()
def distractors(
    source: Sources,
    out: Annotated[Path, typer.Option(help="Folder of the dataset; made by the build.")],
    families: Families = None,
    split: Annotated[str, typer.Option(help="train; others leak query episodes.")] = "train",
    episodes: Episodes = None,
    cameras: Cameras = None,
    codec: CodecName = "av1-lossless",
    version: Version = "1.0.0",
    workers: Workers = _CPUS,
    time_limit: TimeLimit = _TIME_LIMIT,
    columns: Columns = None,
    families_file: FamiliesFile = None,
    as_json: AsJson = False,
) -> None:
    """Build distractor units: 32 frames of each episode, raw indices 0, 8, …, 248.

    Episodes of fewer than 249 raw frames yield no unit; they are listed in meta/build_report.json.
    """
    filters = (families, split, episodes)
    settings = (codec, cameras, version, workers, time_limit)
    opening = (columns, families_file, None)
    _build(DISTRACTORS, source, out, filters, settings, opening, as_json=as_json)


@app.command()
def manifests(
    demonstrations: Annotated[Path, typer.Option(help="Dataset of demonstrations.")],
    distractors: Annotated[Path, typer.Option(help="Dataset of distractor units.")],
    out: Annotated[Path, typer.Option(help="Folder of the manifests.")],
    k: K = None,
    seed: Seed = 0,
    position_limit: Limit = str(POSITION_LIMIT),
    as_json: AsJson = False,
) -> None:
    """Plan the history buffers of all query episodes: the same inputs give the same bytes."""
    _manifests(demonstrations, distractors, out, k, seed, position_limit, as_json=as_json)


@app.command(name="all")
def build_all(
    source: Sources,
    out: Annotated[Path, typer.Option(help="Folder of the split.")],
    families: Annotated[
        str | None, typer.Option(help="Families of the query episodes; all by default.")
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="Split of the query episodes; distractors are train's.")
    ] = None,
    episodes: Annotated[
        str | None, typer.Option(help="Numbers of the query episodes, such as 0-49.")
    ] = None,
    cameras: Cameras = None,
    codec: CodecName = "av1-lossless",
    version: Version = "1.0.0",
    k: K = None,
    seed: Seed = 0,
    position_limit: Limit = str(POSITION_LIMIT),
    workers: Workers = _CPUS,
    time_limit: TimeLimit = _TIME_LIMIT,
    columns: Columns = None,
    families_file: FamiliesFile = None,
) -> None:
    """Build demonstrations, distractors and manifests from the same sources."""
    settings = (codec, cameras, version, workers, time_limit)
    opening = (columns, families_file, None)
    _check_simulators(DISTRACTORS, source)  # before the demonstrations are played
    for kind, filters in (
        (DEMONSTRATIONS, (families, split, episodes)),
        (DISTRACTORS, (None, "train", None)),
    ):
        _build(kind, source, out / kind, filters, settings, opening, as_json=False)
    _manifests(
        out / DEMONSTRATIONS,
        out / DISTRACTORS,
        out / MANIFESTS,
        k,
        seed,
        position_limit,
        as_json=False,
    )
    MESSAGES.print(f"Next: robomme-interference verify {out}")


@app.command()
def sample(
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    train: Annotated[int, typer.Option(help="Train episodes of each family.")] = 2,
    test: Annotated[int, typer.Option(help="Test episodes of each family.")] = 1,
) -> None:
    """Record a small made-up sample, to try everything: --source frames:OUT."""
    from robomme_interference_data.build_dataset.sample import write_sample
    from robomme_interference_data.constants import FAMILIES
    from robomme_interference_data.progress import BuildProgress

    with BuildProgress(unit="episodes") as progress:
        progress.start("Recording the sample", len(FAMILIES) * (train + test))
        for _ in write_sample(out, train=train, test=test):
            progress.advance(1)
    MESSAGES.print(f"Next: robomme-interference build all --source frames:{out} --out my-split")


def _build(
    kind: str,
    source: list[str],
    out: Path,
    filters: tuple[str | None, str | None, str | None],
    settings: tuple[str, str | None, str, int, float],
    opening: tuple[str | None, Path | None, str | None],
    *,
    as_json: bool,
) -> None:
    from robomme_interference_data.build_dataset.build import Filters, Settings, build_dataset
    from robomme_interference_data.build_dataset.encode import get_codec
    from robomme_interference_data.build_dataset.plan import parse_ranges
    from robomme_interference_data.build_dataset.sources import open_source
    from robomme_interference_data.progress import BuildProgress
    from robomme_interference_data.simulators.registry import SIMULATORS

    families, split, episodes = filters
    codec, cameras, version, workers, time_limit = settings
    columns, families_file, robomme_python = opening
    _check_simulators(kind, source)
    chosen = Settings(
        codec=get_codec(codec),
        cameras=_names(cameras),
        version=version,
        workers=workers,
        time_limit=time_limit,
    )
    wanted = Filters(
        families=_names(families),
        split=split,
        numbers=parse_ranges(episodes) if episodes is not None else None,
    )
    recordings = out.parent / f".{out.name}.recordings"
    with _resumable():
        opened = []
        for text in source:
            if text in SIMULATORS:
                played = _record(text, kind, out, recordings, wanted, chosen, robomme_python)
                if played is None:
                    MESSAGES.print(f"{out}: was built before")
                    return
                opened.append(played)
            else:
                opened.append(
                    open_source(text, columns=_column_map(columns), families_file=families_file)
                )
        with BuildProgress() as progress:
            result = build_dataset(kind, opened, out, wanted, chosen, progress)
    shutil.rmtree(recordings, ignore_errors=True)
    if as_json:
        _print_json(
            {
                "out": str(result.out),
                "episodes": result.episodes,
                "frames": result.frames,
                "skipped": [vars(item) for item in result.skipped],
                "existed": result.existed,
            }
        )
        return
    done = "was built before" if result.existed else "built"
    MESSAGES.print(f"{out}: {done}, {result.episodes} episodes, {result.frames:,} frames")
    for item in result.skipped[:10]:
        MESSAGES.print(f"  left out {item.episode_id}: {item.reason}")
    if len(result.skipped) > 10:
        MESSAGES.print(f"  … {len(result.skipped)} left out in all: {out}/meta/build_report.json")


def _check_simulators(kind: str, source: list[str]) -> None:
    """Refuse simulators among the sources that cannot play what is wanted."""
    from robomme_interference_data.build_dataset.record import check_playable
    from robomme_interference_data.simulators.registry import SIMULATORS

    for text in source:
        if text in SIMULATORS:
            check_playable(text, kind)


def _record(
    simulator: str,
    kind: str,
    out: Path,
    recordings: Path,
    wanted: "Filters",
    settings: "Settings",
    robomme_python: str | None,
) -> "Source | None":
    """Play the wanted episodes of a simulator; None if the dataset of them is there already."""
    from robomme_interference_data.build_dataset.record import (
        RecordedSource,
        cameras_to_draw,
        check_unbuilt,
        list_episodes,
        record_episodes,
    )
    from robomme_interference_data.progress import BuildProgress
    from robomme_interference_data.simulators.registry import make_simulator

    options: dict[str, Any] = {"cameras": cameras_to_draw(settings.cameras)}
    # What is recorded with other cameras is not taken for these.
    folder = recordings / "-".join((simulator, *options["cameras"]))
    episodes = list_episodes(simulator, wanted.families, wanted.split, wanted.numbers)
    if not check_unbuilt(out, kind, episodes):
        return None
    if simulator == "robomme":
        options["python"] = robomme_python
        make_simulator(simulator, **options).close()  # one error now, or one for each episode
    with BuildProgress(unit="episodes") as progress:
        progress.start(f"Playing on {simulator}", len(episodes))
        for _ in record_episodes(
            simulator,
            episodes,
            folder,
            live=kind == DISTRACTORS,
            options=options,
            workers=settings.workers,
            time_limit=settings.time_limit,
        ):
            progress.advance(1)
    return RecordedSource(folder, simulator)


def _manifests(
    demonstrations: Path,
    distractors: Path,
    out: Path,
    k: list[int] | None,
    seed: int,
    position_limit: str,
    *,
    as_json: bool,
) -> None:
    from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
    from robomme_interference_data.dataset import Dataset
    from robomme_interference_data.files import LocalFiles, read_json
    from robomme_interference_data.progress import BuildProgress

    queries = Dataset(LocalFiles(demonstrations))
    units = Dataset(LocalFiles(distractors))
    plan = plan_manifests(queries, units, k or DEFAULT_K, seed, _limit(position_limit))
    with BuildProgress(unit="queries") as progress:
        progress.start("Planning buffers", len(queries))
        for done in write_manifests(plan, out):
            progress.advance(done)
    counts = read_json(out / "manifest.json")["counts"]
    if as_json:
        _print_json({"out": str(out), **counts})
    else:
        MESSAGES.print(f"{out}: {counts['buffers']:,} buffers of {counts['queries']:,} queries")


def _limit(text: str) -> int | None:
    if text == "none":
        return None
    if not text.isdecimal() or int(text) == 0:
        raise InvalidOptionError(f"--position-limit {text!r}; expected a positive number or none")
    return int(text)


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(part.strip() for part in text.split(","))


def _column_map(text: str | None) -> dict[str, str] | None:
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name and equals and column for name, equals, column in pairs):
        raise InvalidOptionError(
            f"--columns {text!r} is not NAME=COLUMN,…", "For example: --columns front=image"
        )
    return {name.strip(): column.strip() for name, _, column in pairs}


@contextmanager
def _resumable() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        MESSAGES.print("Stopped. Finished episodes are kept: run the same command again to go on.")
        raise typer.Exit(130) from None


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))
