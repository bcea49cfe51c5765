"""The command `vla-eval-config`."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from robomme_interference_data.cli.console import echo, print_status
from robomme_interference_data.cli.options import BufferSetFolder, Conditions, Families
from robomme_interference_data.storage.files import atomic_path


def vla_eval_config(
    buffer_set: BufferSetFolder,
    system: Annotated[str, typer.Option(help="Label of the rows: a name of your own.")],
    conditions: Conditions = [],  # noqa: B006 - typer reads it only
    families: Families = [],  # noqa: B006
    episodes: Annotated[
        str | None, typer.Option(help="Episode numbers, such as 0-49; default: all.")
    ] = None,
    simulator: Annotated[
        str, typer.Option(help="tabletop, tabletop-day, robomme or module:name.")
    ] = "tabletop",
    url: Annotated[str, typer.Option(help="Address of the server.")] = "ws://localhost:8000",
    output_dir: Annotated[str, typer.Option(help="Folder of vla-eval's results.")] = "results",
    out: Annotated[Path | None, typer.Option(help="File to write; default: print it.")] = None,
) -> None:
    r"""Print a configuration of vla-eval, with which its servers play this benchmark.

    The server must keep histories, except under no-history. score reads the results.

    Example:
    ```
    robomme-interference vla-eval-config my-buffers --system my-model \
      --conditions k0,k7 --out config.yaml
    vla-eval run --no-docker -c config.yaml
    robomme-interference score results/*_aggregate.json --out scores/my-model
    ```
    """
    from .configuration import configuration

    text = configuration(
        buffer_set,
        system,
        conditions=conditions,
        families=families,
        episodes=episodes,
        simulator=simulator,
        url=url,
        output_dir=output_dir,
    )
    if out is None:
        echo(text)
        return
    with atomic_path(out) as partial:
        partial.write_text(text + "\n")
    print_status(f"Run: vla-eval run --no-docker -c {shlex.quote(str(out))}")
