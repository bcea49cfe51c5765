"""The command `simulate`."""

from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from robomme_interference_data.cli.console import check_output, echo, print_json
from robomme_interference_data.cli.options import AsJson
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP

POLICIES = ("oracle", "guess", "none")
"""Built-in policies; `none` plays the demonstration only, which is all that some can do."""


def simulate(
    family: Annotated[str, typer.Option(help="Task family, such as MoveCube.")],
    episode: Annotated[int, typer.Option(help="Index of the episode in its split, from 0.")] = 0,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    policy: Annotated[
        str | None,
        typer.Option(
            help="oracle: knows the answer; guess: draws one; none: only the demonstration. "
            "By default oracle, or none on a simulator that has no other, as robomme.",
        ),
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Write a video here, .mp4.")] = None,
    as_json: AsJson = False,
    simulator: Annotated[str, typer.Option(help="tabletop or robomme.")] = "tabletop",
    shift: Annotated[str, typer.Option(help=SHIFT_HELP)] = NO_SHIFT,
    robomme_python: Annotated[
        str | None,
        typer.Option(help="RoboMME's own interpreter.", envvar="ROBOMME_PYTHON", show_envvar=True),
    ] = None,
) -> None:
    """Play one episode: its demonstration, then a built-in policy.

    The video shows both cameras side by side, under a blue bar during the demonstration and an
    orange one while the policy acts.

    Examples:
    ```
    robomme-interference simulate --family MoveCube --episode 3 --video out.mp4
    robomme-interference simulate --family MoveCube --shift clutter:3 --video out.mp4
    robomme-interference simulate --simulator robomme --robomme-python PATH --family MoveCube
    ```
    """
    from robomme_interference_data.ids import EpisodeId

    from .play import play
    from .registry import check_shift, make_simulator, simulator_class

    check_shift(simulator, shift)
    able = simulator_class(simulator)
    policies = POLICIES if able.scripted else POLICIES[2:]
    policy = policy or policies[0]
    if policy not in policies:
        raise InvalidOptionError.one_of(f"policy on {simulator}", policy, policies)
    if video is not None and (video.suffix != ".mp4" or video.is_dir()):
        raise InvalidOptionError.expected("--video", str(video), "the path of an .mp4 file")
    check_output(video)
    name = EpisodeId(family, split, episode)
    settings: dict[str, Any] = {"shift": shift, "python": robomme_python}
    if video is None:
        settings["cameras"] = ()
    options = {one: settings[one] for one in able.settings if one in settings}
    with closing(make_simulator(simulator, **options)) as running:
        played = play(running, name, policy, video)
    result: dict[str, Any] = {
        "episode": str(name),
        "simulator": played.info.simulator,
        "goal": played.info.goal,
        "difficulty": played.info.difficulty,
        "seed": played.info.seed,
        "shift": shift,
        "policy": policy,
        "status": str(played.status),
        "lesson_frames": played.lesson_frames,
        "steps": played.steps,
    }
    if video is not None:
        result["video"] = str(video)
    if as_json:
        print_json(result)
        return
    for key, value in result.items():
        echo(f"{key.replace('_', ' ')}: {value}")
