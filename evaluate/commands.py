"""The command `evaluate`."""

import json
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.progress import MESSAGES

__all__ = ["evaluate", "merge"]


def evaluate(
    policy: Annotated[
        str,
        typer.Option(
            help="replay, oracle, guess, hold, websocket://host:port[,host:port…], "
            "lerobot:REPO[@REVISION], lerobot:FOLDER or python:module:factory."
        ),
    ],
    split: Annotated[Path, typer.Option(help="Folder of the split of buffers.")],
    out: Annotated[Path, typer.Option(help="Folder of the run; an earlier run is gone on with.")],
    simulator: Annotated[str, typer.Option(help="tabletop or robomme.")] = "tabletop",
    conditions: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME…",
            help="no-history, k0, k1, …; by default all that apply.",
            show_default=False,
        ),
    ] = None,
    families: Annotated[list[str], typer.Option(metavar="NAME…", help="Families, or all.")] = [  # noqa: B006
        "all"
    ],
    episodes: Annotated[str, typer.Option(help="Indices, such as 0-49 or 0,3,10-12.")] = "0-49",
    episode_split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    shard: Annotated[
        str, typer.Option(help="Part of the plan to run, such as 2/8; see merge.")
    ] = "1/1",
    system: Annotated[
        str | None, typer.Option(help="Name for the rows; see docs/systems.md.")
    ] = None,
    memory: Annotated[
        str | None, typer.Option(help="Memory of replay: full, framesamp or window.")
    ] = None,
    policy_option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Option of the policy, such as device=cpu or response_s=60; may be repeated.",
            show_default=False,
        ),
    ] = None,
    model_seed: Annotated[int, typer.Option(help="Seed for the policy.")] = 0,
    retrieval: Annotated[
        str | None,
        typer.Option(help="Put a retrieval step with this encoder in front of the policy."),
    ] = None,
    retrieval_rule: Annotated[
        str, typer.Option(help="METHOD or METHOD/CUT, as for retrieval-score.")
    ] = "max",
    retrieval_camera: Annotated[
        str, typer.Option(help="Camera whose frames the retrieval step compares.")
    ] = "front",
    robomme_python: Annotated[
        str | None,
        typer.Option(help="Interpreter that has RoboMME.", envvar="ROBOMME_PYTHON"),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Worker processes.")] = 1,
    videos: Annotated[
        bool, typer.Option("--videos", help="Write a video of each rollout.")
    ] = False,
    check_lesson: Annotated[
        bool,
        typer.Option(
            "--check-lesson", help="Compare each lesson with what the simulator plays, bit for bit."
        ),
    ] = False,
    rollout_timeout: Annotated[float, typer.Option(help="Seconds a rollout may take.")] = 3600.0,
    simulator_timeout: Annotated[
        float,
        typer.Option(help="Seconds a reset, or 16 steps, may take before the simulator hung."),
    ] = 1800.0,
    cache: Annotated[
        bool,
        typer.Option(
            "--cache", help="Keep decoded history frames on disk: a second run is faster."
        ),
    ] = False,
    history_chunk: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Frames of history handed over at a time."),
    ] = 64,
    max_errors: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Errors in a row after which the run stops."),
    ] = 10,
    no_resume: Annotated[
        bool, typer.Option("--no-resume", help="Refuse a folder that holds a run already.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Write the rows as JSON.")] = False,
) -> None:
    r"""Roll out a policy under the benchmark's conditions, one row per rollout.

    Before each episode the policy gets the history that the condition prescribes: nothing
    (no-history), the lesson (k0), or the lesson and k sessions of other tasks. RUN/rollouts.csv,
    RUN/rollouts.parquet and RUN/run.json hold what came out. Stop it at any time: the same
    command goes on, skips what is finished and repeats what broke.

    Examples:
    ```
    robomme-interference evaluate --policy replay --memory window \
      --split S --out runs/window

    robomme-interference evaluate --policy websocket://localhost:8000 \
      --system perceptual-framesamp-modul --split S --out runs/mine \
      --conditions k0 k7 --families MoveCube RouteStick

    robomme-interference evaluate --policy lerobot:me/act@v1 \
      --system act-v1 --policy-option device=cpu --split S --out runs/act

    robomme-interference evaluate --policy oracle --episodes 0-4 --videos \
      --split S --out runs/oracle

    robomme-interference evaluate --policy replay --shard 2/8 \
      --split S --out runs/shard-2
    ```
    """
    from robomme_interference_data.evaluate.policies.options import read_options, split_options
    from robomme_interference_data.evaluate.policies.registry import policy_factory
    from robomme_interference_data.evaluate.progress import RunProgress, rate_table
    from robomme_interference_data.evaluate.runner import run_evaluation
    from robomme_interference_data.simulators.base import Status

    if memory is not None and policy != "replay":
        raise InvalidOptionError(
            f"--memory {memory} says nothing to the policy {policy}: only replay has memory rules",
            "Leave it out.",
        )
    factory, _ = policy_factory(policy)
    options = read_options(factory, split_options(policy_option or []))
    command = shlex.join(["robomme-interference", *sys.argv[1:]])
    try:
        with _terminable(), RunProgress(quiet=as_json) as progress:
            result = run_evaluation(
                policy,
                split,
                out,
                simulator=simulator,
                conditions=conditions,
                families=families,
                episodes=episodes,
                episode_split=episode_split,
                shard=shard,
                system=system,
                memory=memory,
                policy_options=options,
                model_seed=model_seed,
                retrieval=retrieval,
                retrieval_rule=retrieval_rule,
                retrieval_camera=retrieval_camera,
                robomme_python=robomme_python,
                check_lesson=check_lesson,
                videos=videos,
                workers=workers,
                rollout_s=rollout_timeout,
                simulator_s=simulator_timeout,
                cache=cache,
                history_chunk=history_chunk,
                max_errors=max_errors,
                resume=not no_resume,
                command=[command],
                listener=progress,
            )
    except KeyboardInterrupt as stop:
        MESSAGES.print(f"\nStopped. Finished rollouts are in {out}; go on with:")
        MESSAGES.print(command)
        raise typer.Exit(143 if isinstance(stop, _Terminated) else 130) from None
    except OSError as error:
        if error.errno is not None:  # the system's word on a file, such as that the disk is full
            MESSAGES.print(f"Stopped. Finished rollouts are in {out}; once mended, go on with:")
            MESSAGES.print(command)
        raise
    if as_json:
        typer.echo(json.dumps([row.as_dict() for row in result.rows], ensure_ascii=False))
    else:
        Console().print(rate_table(result.rows))
        typer.echo(f"{len(result.rows)} of {result.planned} rollouts in {out}/rollouts.csv")
    broken = result.counts[str(Status.ERROR)]
    if result.stopped is not None:
        MESSAGES.print(f"Stopped: {result.stopped}", style="red")
    if broken:
        MESSAGES.print(
            f"{broken} rollouts broke (see {out}/errors.log); the same command runs them again:",
        )
        MESSAGES.print(command)
        raise typer.Exit(1)


class _Terminated(KeyboardInterrupt):
    """SIGTERM came."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM, with which schedulers and containers stop a job, stop a run as Ctrl-C does."""

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not cut the ending short
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of the shards of a run.")],
    out: Annotated[Path, typer.Option(help="Folder of the joined run, new.")],
    as_json: Annotated[bool, typer.Option("--json", help="Write what came out as JSON.")] = False,
) -> None:
    """Join shards of a run into one, and tell which rollouts are missing or double.

    The shards must agree in all settings that can change a result. The joined run scores like
    any other, and evaluate with its folder as --out runs what is missing.

    For example:

    ```
    robomme-interference merge runs/shard-1 runs/shard-2 --out runs/whole
    ```
    """
    from robomme_interference_data.evaluate.merge import Cell, merge_runs
    from robomme_interference_data.evaluate.progress import rate_table

    merged = merge_runs(runs, out)
    told = {
        "missing": merged.missing,
        "broken": merged.broken,
        "double": merged.double,
        "differing": merged.differing,
    }
    if as_json:
        typer.echo(json.dumps({"planned": merged.planned, "rows": len(merged.rows), **told}))
        return
    Console().print(rate_table(merged.rows))

    def tell(what: str, cells: tuple[Cell, ...]) -> None:
        shown = ", ".join(f"{family} {condition} {index}" for family, condition, index in cells[:5])
        more = f" and {len(cells) - 5:,} more" if len(cells) > 5 else ""
        MESSAGES.print(f"{len(cells):,} {what}: {shown}{more}")

    for name, cells in told.items():
        if cells:
            tell(_MERGED[name], cells)
    typer.echo(f"{len(merged.rows):,} of {merged.planned:,} rollouts in {out}/rollouts.csv")


_MERGED = {
    "missing": "missing",
    "broken": "broken, to be run again",
    "double": "in more than one run, the first one kept",
    "differing": "of those did not end alike",
}
