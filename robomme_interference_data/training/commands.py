"""The command that trains a LeRobot policy."""

from typing import Annotated

import typer

from robomme_interference_data.cli.options import BufferSetFolder, Families, split_commas
from robomme_interference_data.errors import InvalidOptionError


def train(
    buffer_set: BufferSetFolder,
    lerobot: Annotated[
        list[str] | None,
        typer.Argument(metavar="-- OPTION…", help="Options of lerobot-train.", show_default=False),
    ] = None,
    conditions: Annotated[
        list[str] | None,
        typer.Option(
            help="Conditions to draw from, such as k0 or k0=1,k7=2 with weights; default: all.",
            callback=split_commas,
            metavar="NAME,…",
        ),
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="Split of the episodes; default: train.")
    ] = None,
    families: Families = [],  # noqa: B006 - typer copies it
    episodes: Annotated[
        str | None, typer.Option(help="Indices of query episodes, such as 0-79; default: all.")
    ] = None,
    cameras: Annotated[
        list[str] | None,
        typer.Option(help="Cameras; default: the first.", callback=split_commas, metavar="NAME,…"),
    ] = None,
    redraw: Annotated[
        bool, typer.Option(help="Draw the sessions of the conditions anew in every epoch.")
    ] = False,
    unit_episodes: Annotated[
        str | None, typer.Option(help="With --redraw, train episodes whose units may be drawn.")
    ] = None,
    other_states: Annotated[
        str | None,
        typer.Option(help="States of units of another robot: refuse (default), pad or omit."),
    ] = None,
) -> None:
    r"""Train a LeRobot policy that has a memory, in LeRobot's own training loop.

    Memory rule and image size are the fields `memory` and `image_size` of the policy's
    configuration. A training is resumed with LeRobot's `--resume=true --config_path=…`; options
    left out here are then as before.

    Examples:
    ```
    robomme-interference train my-training --conditions k0,k7 -- \
      --policy.type=history_act --output_dir=runs/act --steps=20000
    robomme-interference train my-training -- --resume=true \
      --config_path=runs/act/checkpoints/last/pretrained_model/train_config.json
    ```
    """
    from .lerobot.version import check_lerobot

    check_lerobot()
    from .lerobot import loop

    given = {
        "conditions": None if conditions is None else dict(map(_weighted, conditions)),
        "split": split,
        "families": families or None,
        "episodes": episodes,
        "cameras": cameras,
        "redraw": redraw or None,
        "unit_episodes": unit_episodes,
        "other_states": other_states,
    }
    loop.train(loop.arguments(buffer_set, given, lerobot or []))


def _weighted(text: str) -> tuple[str, float]:
    name, _, weight = text.partition("=")
    try:
        return name, float(weight or 1)
    except ValueError:
        raise InvalidOptionError.expected("conditions", text, "NAME or NAME=WEIGHT") from None
