"""The command `simulate`."""

from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.cli.console import check_output, echo, print_json
from robomme_interference_data.cli.options import AsJson
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

POLICIES = ("oracle", "guess", "none")
"""Built-in policies; `none` plays the demonstration only, which is all that some can do."""

LESSON, LIVE = (40, 90, 200), (230, 130, 20)
"""Colours of the bar above the pictures."""


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
    from robomme_interference_data.constants import FPS
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.schema.rollouts import Status
    from robomme_interference_data.storage.encode import CLIP, VideoEncoder
    from robomme_interference_data.storage.files import atomic_path

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
    clip: VideoEncoder | None = None
    with ExitStack() as stack:
        # First: minutes are spent on what is to be in it.
        path = None if video is None else stack.enter_context(atomic_path(video))
        running = stack.enter_context(closing(make_simulator(simulator, **options)))
        lesson, seen, info = running.reset(str(name))
        if path is not None:
            first = _picture(seen.images, LIVE)
            height, width, _ = first.shape
            clip = VideoEncoder(path, CLIP, FPS, height, width, container="mp4")
            for index in range(len(lesson)):
                images = {camera: frames[index] for camera, frames in lesson.images.items()}
                clip.add(_picture(images, LESSON))
            clip.add(first)
        steps, status = 0, Status.ONGOING
        while status is Status.ONGOING and policy != "none":
            seen, status = running.step(running.act(policy))
            steps += 1
            if clip is not None:
                clip.add(_picture(seen.images, LIVE))
        if clip is not None:
            clip.close()
    result: dict[str, Any] = {
        "episode": str(name),
        "simulator": info.simulator,
        "goal": info.goal,
        "difficulty": info.difficulty,
        "seed": info.seed,
        "shift": shift,
        "policy": policy,
        "status": str(status),
        "lesson_frames": len(lesson),
        "steps": steps,
    }
    if video is not None:
        result["video"] = str(video)
    if as_json:
        print_json(result)
        return
    for key, value in result.items():
        echo(f"{key.replace('_', ' ')}: {value}")


def _picture(
    images: "dict[str, NDArray[np.uint8]]", colour: tuple[int, int, int]
) -> "NDArray[np.uint8]":
    """Return the cameras side by side, under a bar of a colour."""
    import numpy as np

    views = np.concatenate(list(images.values()), axis=1)
    return np.concatenate([np.full((16, views.shape[1], 3), colour, np.uint8), views])
