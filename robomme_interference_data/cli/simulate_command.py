"""The command `simulate`."""

from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.settings import (
    PYTHON_HELP,
    PYTHON_SHOWN,
    SIMULATOR_OPTION_HELP,
)
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP

from .console import check_output, echo, print_json
from .options import AsJson, EpisodeName


def _option(panel: str, text: str, **more: Any) -> Any:
    return typer.Option(help=text, rich_help_panel=panel, **more)


def simulate(
    episode: EpisodeName,
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
        str, _option("Simulator", "tabletop, tabletop-day, robomme or module:name.")
    ] = "tabletop",
    simulator_python: Annotated[
        str | None, _option("Simulator", PYTHON_HELP, metavar="PATH", show_default=PYTHON_SHOWN)
    ] = None,
    simulator_options: Annotated[
        list[str],
        typer.Option(
            "--simulator-option",
            help=SIMULATOR_OPTION_HELP,
            metavar="NAME=VALUE",
            rich_help_panel="Simulator",
            show_default=False,
        ),
    ] = [],  # noqa: B006 - typer reads it only
    shift: Annotated[str, _option("Simulator", SHIFT_HELP)] = NO_SHIFT,
) -> None:
    r"""Play one episode: its demonstration, then a built-in policy.

    The video shows the cameras side by side, under a bar that names them and what is shown: blue
    during the demonstration, orange while the policy acts.

    Examples:
    ```
    robomme-interference simulate MoveCube/test/3 --video out.mp4
    robomme-interference simulate MoveCube/test/3 --simulator robomme \
      --simulator-python PATH
    ```
    """
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.simulators.play import NO_POLICY, play
    from robomme_interference_data.simulators.registry import (
        check_shift,
        find_simulator_python,
        make_simulator,
        simulator_arguments,
        simulator_class,
    )

    parsed = EpisodeId.parse(episode)
    if parsed.start:  # of a distractor unit
        expected = f"a whole episode, such as {parsed.scene}"
        raise InvalidOptionError.expected("episode", episode, expected)
    name = str(parsed)
    check_shift(simulator, shift)
    supported = simulator_class(simulator)
    policies = (*(name for name in ("oracle", "guess") if name in supported.policies), NO_POLICY)
    if policy not in policies:
        raise InvalidOptionError.one_of(f"policy on {simulator}", policy, policies)
    if video is not None and (video.suffix != ".mp4" or video.is_dir()):
        raise InvalidOptionError.expected("--video", str(video), "the path of an .mp4 file")
    check_output(video)
    python = find_simulator_python(simulator, simulator_python)
    settings: dict[str, Any] = {"shift": shift, "python": python}
    if video is None:
        settings["cameras"] = ()
    arguments = simulator_arguments(simulator, settings, simulator_options)
    with closing(make_simulator(simulator, **arguments)) as running:
        result = play(running, name, policy, video) | {"shift": shift}
    if video is not None:
        result["video"] = str(video)
    if as_json:
        print_json(result)
        return
    for key, value in result.items():
        echo(f"{key.replace('_', ' ')}: {value}")
