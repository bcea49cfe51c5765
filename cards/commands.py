"""The command `card`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.errors import MissingFileError

if TYPE_CHECKING:
    from robomme_interference_data.cards.publication import Publication
    from robomme_interference_data.files import Files


def card(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DIR", help="Folder of a split, of demonstrations or of a run; or a Hub id."
        ),
    ],
    repo_id: Annotated[
        str, typer.Option(help="Repository that the card is for.")
    ] = "namespace/name",
    version: Annotated[str, typer.Option(help="Version that it is of.")] = "1.0.0",
    licence: Annotated[
        str,
        typer.Option("--license", help="Its licence, such as cc-by-4.0; other: the recordings'."),
    ] = "other",
) -> None:
    """Print the card of a split, of demonstrations or of a run: README.md, all of it from data.

    Examples:
    ```
    robomme-interference card my-split --repo-id my-name/my-split
    robomme-interference card my-split/demonstrations --license cc-by-4.0
    robomme-interference card my-run --repo-id my-name/my-results
    ```
    """
    from robomme_interference_data.cards.publication import Publication

    typer.echo(card_text(source, Publication(repo_id, version, licence)), nl=False)


def card_text(source: str, about: "Publication") -> str:
    """Return the card of whatever lies in a folder, or on the Hub under a name.

    Raises:
        MissingFileError: There is no split, no dataset and no run.
        InvalidOptionError: It is neither a folder nor the name of a repository.
        MissingExtraError: jinja2 is not installed.
        InterferenceError: It cannot be read.
    """
    from robomme_interference_data.cards import render
    from robomme_interference_data.constants import (
        IDENTITY_PATH,
        MANIFEST_PATH,
        RUN_HEADER,
        RUN_RECORD,
        RUN_TABLES,
    )
    from robomme_interference_data.dataset import Dataset
    from robomme_interference_data.hub import locate
    from robomme_interference_data.loading import load_split

    if Path(source).is_file():
        return render.results_text(Path(source), about)
    files = locate(source)
    if _has(files, MANIFEST_PATH):
        return render.split_text(load_split(files.describe()), about)
    if _has(files, IDENTITY_PATH):
        return render.demonstrations_text(Dataset(files), about)
    if _has(files, RUN_HEADER):
        return render.results_text(files.snapshot(RUN_HEADER, RUN_RECORD, *RUN_TABLES), about)
    raise MissingFileError(
        f"{files.describe()} holds no split, no demonstrations and no run: {MANIFEST_PATH}, "
        f"{IDENTITY_PATH} and {RUN_HEADER} are missing",
        "Point to the folder that robomme-interference build or evaluate wrote.",
    )


def _has(files: "Files", path: str) -> bool:
    try:
        return files.path(path).is_file()
    except MissingFileError:
        return False
