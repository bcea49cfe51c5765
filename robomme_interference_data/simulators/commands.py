"""The command `simulate`."""

from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.console import AsJson, print_json
from robomme_interference_data.errors import InvalidOptionError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["simulate"]

POLICIES = ("oracle", "guess", "none")
"""Built-in policies; `none` plays the demonstration only, which is all that robomme can do."""

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
            "By default oracle, or none on robomme, which has no other.",
        ),
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Write a video here, .mp4.")] = None,
    as_json: AsJson = False,
    simulator: Annotated[str, typer.Option(help="tabletop or robomme.")] = "tabletop",
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
    robomme-interference simulate --simulator robomme --robomme-python PATH --family MoveCube
    ```
    """
    from robomme_interference_data.files import atomic_path
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.records import Status
    from robomme_interference_data.simulators.registry import make_simulator

    policies = POLICIES if simulator != "robomme" else POLICIES[2:]
    policy = policy or policies[0]
    if policy not in policies:
        raise InvalidOptionError.one_of(f"--policy on {simulator}", policy, policies)
    if video is not None and (video.suffix != ".mp4" or video.is_dir()):
        raise InvalidOptionError.expected("--video", str(video), "the path of an .mp4 file")
    name = EpisodeId(family, split, episode)
    options: dict[str, Any] = {}
    if simulator == "tabletop":
        options = {"render": video is not None}
    elif simulator == "robomme":
        options = {"python": robomme_python}
    with ExitStack() as stack:
        # First: minutes are spent on what is to be in it.
        clip = None if video is None else _Clip(stack.enter_context(atomic_path(video)))
        running = stack.enter_context(closing(make_simulator(simulator, **options)))
        lesson, seen, info = running.reset(str(name))
        if clip is not None:
            for index in range(len(lesson)):
                clip.add({camera: f[index] for camera, f in lesson.images.items()}, LESSON)
            clip.add(seen.images, LIVE)
        steps, status = 0, Status.ONGOING
        while status is Status.ONGOING and policy != "none":
            seen, status = running.step(running.act(policy))
            steps += 1
            if clip is not None:
                clip.add(seen.images, LIVE)
        if clip is not None:
            clip.close()
    result: dict[str, Any] = {
        "episode": str(name),
        "simulator": info.simulator,
        "goal": info.goal,
        "difficulty": info.difficulty,
        "seed": info.seed,
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
        typer.echo(f"{key.replace('_', ' ')}: {value}")


class _Clip:
    """Both cameras side by side, under a bar of a colour, frame by frame into a file."""

    def __init__(self, path: Path):
        self._path = path
        self._encoder: Any = None

    def add(self, images: "dict[str, NDArray[np.uint8]]", colour: tuple[int, int, int]) -> None:
        import numpy as np

        from robomme_interference_data.constants import FPS
        from robomme_interference_data.encode import CLIP, VideoEncoder

        picture = np.concatenate(list(images.values()), axis=1)
        bar = np.full((16, picture.shape[1], 3), colour, np.uint8)
        picture = np.concatenate([bar, picture])
        if self._encoder is None:
            height, width, _ = picture.shape
            self._encoder = VideoEncoder(self._path, CLIP, FPS, height, width, container="mp4")
        self._encoder.add(picture)

    def close(self) -> None:
        self._encoder.close()
