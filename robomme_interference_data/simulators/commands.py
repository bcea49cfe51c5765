"""The commands `simulate` and `simulate-score`."""

import json
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import MofNCompleteColumn, Progress

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.progress import MESSAGES
from robomme_interference_data.simulators.base import Observation, Status

__all__ = ["simulate", "simulate_score"]


POLICIES = ("oracle", "guess")

NO_POLICY = "none"
"""Plays the demonstration only: all that there is to see where no policy is built in."""

Policy = Annotated[str, typer.Option(help="oracle: knows the answer; guess: draws one.")]
Json = Annotated[bool, typer.Option("--json", help="Write JSON to standard output.")]


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
    as_json: Json = False,
    simulator: Annotated[str, typer.Option(help="tabletop or robomme.")] = "tabletop",
    robomme_python: Annotated[
        Path | None,
        typer.Option(help="RoboMME's own interpreter.", envvar="ROBOMME_PYTHON", show_envvar=True),
    ] = None,
) -> None:
    """Play one episode: its demonstration, then a built-in policy.

    The video shows both cameras side by side, under a blue bar during the demonstration and an
    orange one while the policy acts.

    Examples:
    robomme-interference simulate --family MoveCube --episode 3 --video out.mp4;
    robomme-interference simulate --simulator robomme --robomme-python PATH --family MoveCube
    """
    from robomme_interference_data.ids import EpisodeId
    from robomme_interference_data.simulators.registry import make_simulator

    policies = (NO_POLICY,) if simulator == "robomme" else (*POLICIES, NO_POLICY)
    policy = policy or policies[0]
    _check(policy, policies)
    if video is not None and video.suffix != ".mp4":
        raise InvalidOptionError(
            f"cannot write {video}: only .mp4 is written", "Give a path that ends in .mp4."
        )
    if video is not None:
        _check_folder(video)
    name = EpisodeId(family, split, episode)
    options: dict[str, Any] = {}
    if simulator == "tabletop":
        options = {"render": video is not None}
    elif simulator == "robomme":
        options = {"python": robomme_python}
    with closing(make_simulator(simulator, **options)) as running:
        lesson, first, info = running.reset(str(name))
        live, status = [first], Status.ONGOING
        while status is Status.ONGOING and policy != NO_POLICY:
            seen, status = running.step(running.act(policy))
            live.append(seen)
    result: dict[str, Any] = {
        "episode": str(name),
        "simulator": info.simulator,
        "goal": info.goal,
        "difficulty": info.difficulty,
        "seed": info.seed,
        "policy": policy,
        "status": str(status),
        "lesson_frames": len(lesson),
        "steps": len(live) - 1,
    }
    if video is not None:
        frames = [_picture(lesson.images, (40, 90, 200), index) for index in range(len(lesson))]
        frames += [_picture(_one(seen), (230, 130, 20), 0) for seen in live]
        _write_video(video, frames)
        result["video"] = str(video)
    if as_json:
        typer.echo(json.dumps(result, ensure_ascii=False))
    else:
        for key, value in result.items():
            typer.echo(f"{key.replace('_', ' ')}: {value}")


def simulate_score(
    policy: Policy = "oracle",
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    family: Annotated[str | None, typer.Option(help="One family; all by default.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 1,
    as_json: Json = False,
) -> None:
    """Play all episodes of a split with a built-in policy, and write a Markdown table.

    Example: robomme-interference simulate-score --policy guess --workers 2
    """
    from robomme_interference_data.simulators.score import markdown_table, play_all
    from robomme_interference_data.simulators.tabletop.episodes import episode_ids

    _check(policy, POLICIES)
    episodes, outcomes = episode_ids(family, split), []
    with Progress(
        *Progress.get_default_columns(), MofNCompleteColumn(), console=MESSAGES
    ) as progress:
        bar = progress.add_task("episodes", total=len(episodes))
        for outcome in play_all(policy, episodes, workers=workers):
            outcomes.append(outcome)
            progress.advance(bar)
            if outcome.why or (policy == "oracle" and outcome.status is not Status.SUCCESS):
                MESSAGES.print(f"{outcome.episode}: {outcome.status} {outcome.why}")
    outcomes.sort(key=lambda outcome: episodes.index(outcome.episode))
    if as_json:
        rows = [{**vars(o), "episode": str(o.episode), "status": str(o.status)} for o in outcomes]
        typer.echo(json.dumps(rows))
    else:
        typer.echo(markdown_table(outcomes))


def _check(policy: str, policies: Sequence[str]) -> None:
    if policy not in policies:
        raise UnknownNameError(
            f"there is no built-in policy {policy!r} here; expected {' or '.join(policies)}",
            nearest(policy, policies),
        )


def _check_folder(video: Path) -> None:
    """Make the folder of a video, before minutes are spent on what is to be in it."""
    hint = "Give a path in a folder where you may write."
    if video.is_dir():
        raise InvalidOptionError(f"cannot write {video}: it is a folder", hint)
    try:
        video.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=video.parent):
            pass
    except OSError as error:
        raise InvalidOptionError(f"cannot write {video}: {error.strerror}", hint) from error


def _one(seen: Observation) -> dict[str, NDArray[np.uint8]]:
    return {name: image[None] for name, image in seen.images.items()}


def _picture(
    images: dict[str, NDArray[np.uint8]], colour: tuple[int, int, int], index: int
) -> NDArray[np.uint8]:
    """Both cameras side by side under a bar of a colour."""
    picture = np.concatenate([images["front"][index], images["wrist"][index]], axis=1)
    bar = np.empty((16, picture.shape[1], 3), np.uint8)
    bar[:] = colour
    return np.concatenate([bar, picture])


def _write_video(path: Path, frames: list[NDArray[np.uint8]]) -> None:
    import av

    from robomme_interference_data.constants import FPS
    from robomme_interference_data.files import atomic_path

    with atomic_path(path) as partial, av.open(str(partial), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "20"}
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
