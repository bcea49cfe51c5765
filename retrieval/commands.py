"""The commands of retrieval: `index`, `calibrate`, `retrieve` and `retrieval-score`."""

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, INFO_PATH
from robomme_interference_data.errors import MissingFileError

__all__ = ["index"]


Encoder = Annotated[
    str,
    typer.Option(
        help="thumbnail (no weights), siglip (the paper's model), or siglip:ID with the id or "
        "folder of another SigLIP or SigLIP 2 model."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def index(
    data: Annotated[Path, typer.Option(help="Folder of a split, or of one dataset.")],
    encoder: Encoder = "thumbnail",
    camera: Annotated[str, typer.Option(help="Camera to embed.")] = "front",
    device: Annotated[
        str | None,
        typer.Option(help="Where siglip computes.", show_default="a GPU if there is one"),
    ] = None,
    batch: Annotated[
        int | None, typer.Option(help="Images at a time.", show_default="what suits the encoder")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(help="Threads that decode.", show_default="all processors")
    ] = None,
    as_json: Json = False,
) -> None:
    """Embed every stored frame once, and keep the embeddings beside the data.

    Goes on where an interrupted run stopped; does nothing if the index is there and right.

    Example: robomme-interference index --data my-split --encoder thumbnail
    """
    from robomme_interference_data.progress import BuildProgress
    from robomme_interference_data.retrieval.encoders import make_encoder
    from robomme_interference_data.retrieval.index import build_index

    roots = datasets_in(data)
    made = make_encoder(encoder, device=device, batch=batch)
    with BuildProgress(quiet=as_json) as progress:
        reports = build_index(
            roots, made, progress, camera=camera, threads=threads or os.cpu_count() or 1
        )
    if as_json:
        rows = [
            {
                "folder": str(report.folder),
                "frames": report.frames,
                "embedded": report.embedded,
                "typical_cosine": report.typical_cosine,
            }
            for report in reports
        ]
        typer.echo(json.dumps(rows))
        return
    for report in reports:
        typer.echo(f"{report.folder}: {report.frames} frames, {report.embedded} embedded now")


def datasets_in(data: Path) -> list[Path]:
    """Return the datasets of a split, or the one dataset that a folder is.

    Raises:
        MissingFileError: The folder is neither.
    """
    if (data / INFO_PATH).is_file():
        return [data]
    both = [data / DEMONSTRATIONS, data / DISTRACTORS]
    if all((root / INFO_PATH).is_file() for root in both):
        return both
    raise MissingFileError(
        f"{data} is neither a split (with {DEMONSTRATIONS}/ and {DISTRACTORS}/) nor a dataset "
        f"(with {INFO_PATH})",
        f"Point to one, or make one: robomme-interference build all --source KIND:PATH "
        f"--out {data}",
    )
