"""Commands that make splits: `build …`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFESTS,
    POSITION_LIMIT,
)
from robomme_interference_data.progress import MESSAGES

if TYPE_CHECKING:
    pass

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
    float | None,
    typer.Option(
        help="Seconds that one episode may take before it is tried once more.",
        show_default="120 to play one on tabletop; 1800 otherwise",
    ),
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
    time_limit: TimeLimit = None,
    columns: Columns = None,
    families_file: FamiliesFile = None,
    robomme_python: RoboMMEPython = None,
    as_json: AsJson = False,
) -> None:
    """Build the query episodes' demonstrations, each with its first live observation at the end.

    Stopped with Ctrl-C, or killed, a build goes on where it was when the command is run again.
    """
    from robomme_interference_data.build_dataset.steps import build_one

    filters = (families, split, episodes)
    settings = (codec, cameras, version, workers, time_limit)
    opening = (columns, families_file, robomme_python)
    build_one(DEMONSTRATIONS, source, out, filters, settings, opening, as_json=as_json)


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
    time_limit: TimeLimit = None,
    columns: Columns = None,
    families_file: FamiliesFile = None,
    as_json: AsJson = False,
) -> None:
    """Build distractor units: 32 frames of each episode, raw indices 0, 8, …, 248.

    Episodes of fewer than 249 raw frames yield no unit; they are listed in meta/build_report.json.
    """
    from robomme_interference_data.build_dataset.steps import build_one

    filters = (families, split, episodes)
    settings = (codec, cameras, version, workers, time_limit)
    opening = (columns, families_file, None)
    build_one(DISTRACTORS, source, out, filters, settings, opening, as_json=as_json)


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
    from robomme_interference_data.build_dataset.steps import plan_buffers

    plan_buffers(demonstrations, distractors, out, k, seed, position_limit, as_json=as_json)


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
    time_limit: TimeLimit = None,
    columns: Columns = None,
    families_file: FamiliesFile = None,
) -> None:
    """Build demonstrations, distractors and manifests from the same sources."""
    from robomme_interference_data.build_dataset.steps import (
        build_one,
        check_simulators,
        plan_buffers,
    )

    settings = (codec, cameras, version, workers, time_limit)
    opening = (columns, families_file, None)
    check_simulators(DISTRACTORS, source)  # before the demonstrations are played
    for kind, filters in (
        (DEMONSTRATIONS, (families, split, episodes)),
        (DISTRACTORS, (None, "train", None)),
    ):
        build_one(kind, source, out / kind, filters, settings, opening, as_json=False)
    plan_buffers(
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
