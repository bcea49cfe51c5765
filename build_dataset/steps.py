"""What the build commands do: play or open the sources, build a dataset, plan manifests."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer

from robomme_interference_data.build_dataset.build import Filters, Settings, build_dataset
from robomme_interference_data.build_dataset.encode import get_codec
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan import parse_ranges
from robomme_interference_data.build_dataset.record import (
    RecordedSource,
    cameras_to_draw,
    check_playable,
    check_unbuilt,
    list_episodes,
    record_episodes,
    recorded_from,
)
from robomme_interference_data.build_dataset.sources import Source, open_source
from robomme_interference_data.constants import DEFAULT_K, DISTRACTORS
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.files import LocalFiles, read_json
from robomme_interference_data.progress import MESSAGES, BuildProgress
from robomme_interference_data.simulators.registry import SIMULATORS, make_simulator

__all__ = ["build_one", "check_simulators", "plan_buffers"]


def build_one(
    kind: str,
    source: list[str],
    out: Path,
    filters: tuple[str | None, str | None, str | None],
    settings: tuple[str, str | None, str, int, float | None],
    opening: tuple[str | None, Path | None, str | None],
    *,
    as_json: bool,
) -> None:
    """Build one dataset and tell what came of it.

    Args:
        kind: `demonstrations` or `distractors`.
        source: Sources, as `--source` has them.
        out: Folder of the dataset.
        filters: Options `--families`, `--split`, `--episodes`.
        settings: Options `--codec`, `--cameras`, `--version`, `--workers`, `--time-limit`.
        opening: Options `--columns`, `--families-file`, `--robomme-python`.
        as_json: Whether to print the result as JSON.
    """
    families, split, episodes = filters
    codec, cameras, version, workers, time_limit = settings
    columns, families_file, robomme_python = opening
    check_simulators(kind, source)
    chosen = Settings(
        codec=get_codec(codec),
        cameras=_names(cameras),
        version=version,
        workers=workers,
        time_limit=_time_limit(None, time_limit),
    )
    wanted = Filters(
        families=_names(families),
        split=split,
        numbers=parse_ranges(episodes) if episodes is not None else None,
    )
    recordings = out.parent / f".{out.name}.recordings"
    with _resumable():
        opened = []
        for text in source:
            if text in SIMULATORS:
                playing = replace(chosen, time_limit=_time_limit(text, time_limit))
                played = _record(text, kind, out, recordings, wanted, playing, robomme_python)
                if played is None:
                    MESSAGES.print(f"{out}: was built before")
                    return
                opened.append(played)
            else:
                opened.append(
                    open_source(text, columns=_column_map(columns), families_file=families_file)
                )
        with BuildProgress() as progress:
            result = build_dataset(kind, opened, out, wanted, chosen, progress)
    shutil.rmtree(recordings, ignore_errors=True)
    if as_json:
        _print_json(
            {
                "out": str(result.out),
                "episodes": result.episodes,
                "frames": result.frames,
                "skipped": [vars(item) for item in result.skipped],
                "existed": result.existed,
            }
        )
        return
    done = "was built before" if result.existed else "built"
    MESSAGES.print(f"{out}: {done}, {result.episodes} episodes, {result.frames:,} frames")
    for item in result.skipped[:10]:
        MESSAGES.print(f"  left out {item.episode_id}: {item.reason}")
    if len(result.skipped) > 10:
        MESSAGES.print(f"  … {len(result.skipped)} left out in all: {out}/meta/build_report.json")


def check_simulators(kind: str, source: list[str]) -> None:
    """Refuse simulators among the sources that cannot play what is wanted."""
    for text in source:
        if text in SIMULATORS:
            check_playable(text, kind)


def _record(
    simulator: str,
    kind: str,
    out: Path,
    recordings: Path,
    wanted: Filters,
    settings: Settings,
    robomme_python: str | None,
) -> Source | None:
    """Play the wanted episodes of a simulator; None if the dataset of them is there already."""
    drawn = cameras_to_draw(settings.cameras)
    options: dict[str, Any] = {"cameras": drawn}
    # What is recorded with other cameras, or of another suite, is not taken for these.
    folder = recordings / "-".join((*map(str, recorded_from(simulator).values()), *drawn))
    episodes = list_episodes(simulator, wanted.families, wanted.split, wanted.numbers)
    if not check_unbuilt(out, kind, episodes, simulator):
        return None
    if simulator == "robomme":
        options["python"] = robomme_python
        make_simulator(simulator, **options).close()  # one error now, or one for each episode
    with BuildProgress(unit="episodes") as progress:
        progress.start(f"Playing on {simulator}", len(episodes))
        for _ in record_episodes(
            simulator,
            episodes,
            folder,
            live=kind == DISTRACTORS,
            options=options,
            workers=settings.workers,
            time_limit=settings.time_limit,
        ):
            progress.advance(1)
    return RecordedSource(folder, simulator)


def _time_limit(simulator: str | None, given: float | None) -> float:
    """Return the seconds that playing an episode on a simulator, or encoding one, may take."""
    if given is not None:
        return given
    # An episode takes the tabletop seconds, and RoboMME minutes.
    return 120.0 if simulator == "tabletop" else 1800.0


def plan_buffers(
    demonstrations: Path,
    distractors: Path,
    out: Path,
    k: list[int] | None,
    seed: int,
    position_limit: str,
    *,
    as_json: bool,
) -> None:
    """Plan the buffers of two datasets, write the manifests and tell how many they are."""
    queries = Dataset(LocalFiles(demonstrations))
    units = Dataset(LocalFiles(distractors))
    plan = plan_manifests(queries, units, k or DEFAULT_K, seed, _limit(position_limit))
    with BuildProgress(unit="queries") as progress:
        progress.start("Planning buffers", len(queries))
        for done in write_manifests(plan, out):
            progress.advance(done)
    counts = read_json(out / "manifest.json")["counts"]
    if as_json:
        _print_json({"out": str(out), **counts})
    else:
        MESSAGES.print(f"{out}: {counts['buffers']:,} buffers of {counts['queries']:,} queries")


def _limit(text: str) -> int | None:
    if text == "none":
        return None
    if not text.isdecimal() or int(text) == 0:
        raise InvalidOptionError(f"--position-limit {text!r}; expected a positive number or none")
    return int(text)


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(part.strip() for part in text.split(","))


def _column_map(text: str | None) -> dict[str, str] | None:
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name and equals and column for name, equals, column in pairs):
        raise InvalidOptionError(
            f"--columns {text!r} is not NAME=COLUMN,…", "For example: --columns front=image"
        )
    return {name.strip(): column.strip() for name, _, column in pairs}


@contextmanager
def _resumable() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        MESSAGES.print("Stopped. Finished episodes are kept: run the same command again to go on.")
        raise typer.Exit(130) from None


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False))
