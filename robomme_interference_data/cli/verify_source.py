"""The part of the command `verify` that checks recorded episodes before a build."""

import dataclasses
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, PAPER_UNIT, SPLITS
from robomme_interference_data.errors import (
    SAME_FOR_ALL,
    InterferenceError,
    InvalidOptionError,
    counted,
    named,
)
from robomme_interference_data.schema.settings import changed_settings

from .console import echo, graceful_interrupt, print_json, print_status

if TYPE_CHECKING:
    from robomme_interference_data.build_dataset.config import SourceConfig
    from robomme_interference_data.build_dataset.dataset.plan import PlannedEpisode
    from robomme_interference_data.build_dataset.sources import Source
    from robomme_interference_data.build_dataset.verify.source import Problem, SourceReport


def verify_sources(config: "SourceConfig", root: Path, *, as_json: bool) -> None:
    """Read all episodes of sources and print everything that is wrong; fail if there is anything.

    Args:
        config: The sources, and how they are read.
        root: The folder that a build would write.
        as_json: Whether to write JSON to stdout.
    """
    from robomme_interference_data.build_dataset.config import chosen_cameras
    from robomme_interference_data.build_dataset.verify.source import CheckTask, check_sources
    from robomme_interference_data.progress import WorkProgress
    from robomme_interference_data.runtime.executor import Serial, make_executor

    with graceful_interrupt("Nothing is kept"):
        names, sources, episodes, problems = _listed(config, root)
        workers = config.fitting(max((source.worker_gb for source in sources), default=0))
        task = CheckTask(sources, chosen_cameras(config.cameras), config.fps)
        with WorkProgress(unit="episodes") as progress:
            progress.start("Reading", len(episodes))
            # One worker needs no process of its own: there is nothing to write.
            alone = workers.workers == 1 and not workers.on_cluster
            executor = Serial() if alone else make_executor(workers)
            report = check_sources(names, task, episodes, executor, progress.advance)
    report = dataclasses.replace(report, problems=[*problems, *report.problems])
    command = _build_command(config, root, report)
    if as_json:
        print_json(_as_dict(report) | {"next": None if report.problems else command})
    else:
        _print(report)
        if not report.problems:
            print_status(f"Next: {command}")
    if report.problems:
        raise typer.Exit(1)


def _listed(
    config: "SourceConfig", root: Path
) -> "tuple[list[str], tuple[Source, ...], list[PlannedEpisode], list[Problem]]":
    """Open the sources; return those that list episodes, the chosen ones, and problems."""
    from robomme_interference_data.build_dataset.config import BuildConfig
    from robomme_interference_data.build_dataset.dataset.plan import PlannedEpisode
    from robomme_interference_data.build_dataset.plan.datasets import check_values, open_sources
    from robomme_interference_data.build_dataset.plan.episodes import in_selection
    from robomme_interference_data.build_dataset.verify.source import Problem
    from robomme_interference_data.ids import parse_numbers

    build = BuildConfig(root, **_settings(config))
    check_values(build)
    if config.split is not None and config.split not in SPLITS:
        raise InvalidOptionError.one_of("split", config.split, SPLITS)
    indices = None if config.episodes is None else {*parse_numbers(config.episodes)}
    names, sources, episodes, problems = [], list[Any](), [], []
    for name in config.source:
        try:
            only = dataclasses.replace(build, source=(name,))
            [source] = open_sources(DEMONSTRATIONS, only, PAPER_UNIT)
            listed = source.episodes()
        except SAME_FOR_ALL:
            raise
        except InterferenceError as error:
            problems.append(Problem(name, None, None, error.message, error.hint))
            continue
        number = len(sources)
        names.append(name)
        sources.append(source)
        chosen = [episode for episode in listed if in_selection(episode, config.split, indices)]
        episodes += [PlannedEpisode(number, episode) for episode in chosen]
        if not chosen:
            what = f"none of its {counted(len(listed), 'episode')} is chosen"
            hint = f"Change {named('split')} and {named('episodes')}." if listed else None
            problems.append(Problem(name, None, None, what, hint))
    episodes.sort(key=lambda planned: (planned.episode.id.sort_key, planned.source))
    return names, tuple(sources), episodes, problems


def _settings(config: "SourceConfig") -> dict[str, Any]:
    return {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}


def _build_command(config: "SourceConfig", root: Path, report: "SourceReport") -> str:
    """Return the command that builds the sources with the same settings."""
    from robomme_interference_data.runtime.executor import WorkersConfig

    words = ["robomme-interference", "build", shlex.quote(str(root))]
    if not report.with_demonstration:  # no episode can be a query
        words += ["--only", DISTRACTORS]
    words += [named("source", source) for source in config.source]
    workers = [field.name for field in dataclasses.fields(WorkersConfig)]
    for name in changed_settings(config, ["source", *workers]):
        value = getattr(config, name)
        words.append(named(name, ",".join(value) if isinstance(value, tuple) else value))
    return " ".join(words)


def _print(report: "SourceReport") -> None:
    from robomme_interference_data.build_dataset.alike import describe

    hints = dict[str, int]()
    for problem in report.problems:
        echo(str(problem))
        if problem.hint:
            hints[problem.hint] = hints.get(problem.hint, 0) + 1
    for hint, count in hints.items():
        times = f" ({counted(count, 'problem')})" if len(report.problems) > 1 else ""
        print_status(f"{hint}{times}")
    for look, count in report.looks:
        print_status(f"{counted(count, 'episode')}: {describe(look)}")
    read = f"{counted(report.episodes, 'episode')}, {counted(report.frames, 'frame')}"
    print_status(
        f"Read: {read}. {report.with_demonstration:,} with a demonstration and live frames, "
        f"{report.exact:,} bit-exact."
    )
    if report.problems:
        with_problems = {problem.episode for problem in report.problems if problem.episode}
        where = f" in {counted(len(with_problems), 'episode')}" if with_problems else ""
        print_status(f"{counted(len(report.problems), 'problem')}{where}.")
    else:
        print_status("No problems.")


def _as_dict(report: "SourceReport") -> dict[str, Any]:
    return {
        "problems": [vars(problem) for problem in report.problems],
        "episodes": report.episodes,
        "frames": report.frames,
        "episodes_with_demonstration": report.with_demonstration,
        "exact_episodes": report.exact,
        "robots": [
            {
                "episodes": count,
                "features": {name: list(shape) for name, shape in look.features.items()},
                "fps": look.fps,
                "robot_type": look.robot_type,
                "names": {name: list(names) for name, names in look.names.items()},
            }
            for look, count in report.looks
        ],
    }
