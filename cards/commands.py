"""The command `card`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from robomme_interference_data.cards.publication import Publication


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
    robomme-interference card my-run > README.md
    ```
    """
    from robomme_interference_data.cards.publication import Publication

    typer.echo(card_text(source, Publication(repo_id, version, licence)), nl=False)


def card_text(source: str, about: "Publication") -> str:
    """Return the card of whatever lies in a folder, or on the Hub under a name.

    Raises:
        MissingFileError: There is no split, no dataset and no run.
        MissingExtraError: jinja2 is not installed.
        InterferenceError: It cannot be read.
    """
    from robomme_interference_data.cards import render
    from robomme_interference_data.constants import (
        IDENTITY_PATH,
        MANIFEST_HEADER,
        MANIFESTS,
        RUN_HEADER,
    )
    from robomme_interference_data.dataset import Dataset
    from robomme_interference_data.files import LocalFiles
    from robomme_interference_data.split import load_split

    folder = Path(source)
    split = (folder / MANIFESTS / MANIFEST_HEADER).is_file()
    if not split and (folder / IDENTITY_PATH).is_file():
        return render.demonstrations_text(Dataset(LocalFiles(folder)), about)
    if folder.is_file() or (folder / RUN_HEADER).is_file():
        return render.results_text(folder, about)
    return render.split_text(load_split(source), about)
