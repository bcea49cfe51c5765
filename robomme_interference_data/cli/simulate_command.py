"""The command `simulate`."""

from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP

from .console import check_output, echo, print_json
from .options import AsJson


def _option(panel: str, text: str, **more: Any) -> Any:
    return typer.Option(help=text, rich_help_panel=panel, **more)


def simulate(
    family: Annotated[str, _option("Episode", "Task family, such as MoveCube.")],
    episode: Annotated[int, _option("Episode", "Index of the episode in its split, from 0.")] = 0,
    split: Annotated[str, _option("Episode", "train, val, test or heldout.")] = "test",
    policy: Annotated[
        str,
        _option(
            "Policy",
            "oracle: knows the answer; guess: draws one at random; none: plays the demonstration "
            "only.",
        ),
    ] = "oracle",
    video: Annotated[Path | None, _option("Output", "Write a video to this .mp4 file.")] = None,
    as_json: AsJson = False,
    simulator: Annotated[
        str, _option("Simulator", "tabletop, robomme (its Python: ROBOMME_PYTHON) or module:name.")
    ] = "tabletop",
    shift: Annotated[str, _option("Simulator", SHIFT_HELP)] = NO_SHIFT,
) -> None:
    r"""Play one episode: its demonstration, then a built-in policy.

    The video shows the cameras side by side, under a bar that names them and what is shown: blue
    during the demonstration, orange while the policy acts.

    Examples:
    ```
    robomme-interference simulate --family MoveCube --episode 3 --video out.mp4
    ROBOMME_PYTHON=PATH robomme-interference simulate --simulator robomme \
      --family MoveCube
    ```
    """
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.simulators.play import NO_POLICY, play
    from robomme_interference_data.simulators.registry import (
        accepted_settings,
        check_shift,
        make_simulator,
        simulator_class,
    )

    check_shift(simulator, shift)
    supported = simulator_class(simulator)
    policies = (*(name for name in ("oracle", "guess") if name in supported.policies), NO_POLICY)
    if policy not in policies:
        raise InvalidOptionError.one_of(f"policy on {simulator}", policy, policies)
    if video is not None and (video.suffix != ".mp4" or video.is_dir()):
        raise InvalidOptionError.expected("--video", str(video), "the path of an .mp4 file")
    check_output(video)
    name = str(EpisodeId(family, split, episode))
    settings: dict[str, Any] = {"shift": shift}
    if video is None:
        settings["cameras"] = ()
    options = accepted_settings(simulator, settings)
    with closing(make_simulator(simulator, **options)) as running:
        result = play(running, name, policy, video) | {"shift": shift}
    if video is not None:
        result["video"] = str(video)
    if as_json:
        print_json(result)
        return
    for key, value in result.items():
        echo(f"{key.replace('_', ' ')}: {value}")
