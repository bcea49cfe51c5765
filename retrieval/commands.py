"""The commands of retrieval: `index`, `retrieve`, `retrieval-score` and `calibrate`."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, INFO_PATH
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.progress import MESSAGES

if TYPE_CHECKING:
    from robomme_interference_data.loader import Split
    from robomme_interference_data.retrieval.grade import Measured

__all__ = ["calibrate", "index", "retrieval_score", "retrieve"]


SplitFolder = Annotated[
    Path,
    typer.Option(envvar="ROBOMME_INTERFERENCE_SPLIT", help="Folder of the split."),
]
Encoder = Annotated[
    str,
    typer.Option(
        help="thumbnail (no weights), siglip (the paper's model), or siglip:ID with the id or "
        "folder of another SigLIP or SigLIP 2 model."
    ),
]
Camera = Annotated[str, typer.Option(help="Camera whose frames are compared.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def index(
    data: Annotated[Path, typer.Option(help="Folder of a split, or of one dataset.")],
    encoder: Encoder = "thumbnail",
    camera: Annotated[str, typer.Option(help="Camera to embed.")] = "front",
    device: Annotated[
        str | None,
        typer.Option(help="Where siglip computes.", show_default="a GPU if there is one"),
    ] = None,
    batch: Annotated[
        int | None, typer.Option(help="Images at a time.", show_default="what suits the encoder")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(help="Threads that decode.", show_default="all processors")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Make it again from nothing.")] = False,
    as_json: Json = False,
) -> None:
    """Embed every stored frame once, and keep the embeddings beside the data.

    Goes on where an interrupted run stopped. An index that is there and right is kept, even if
    another device computed it.

    Example: robomme-interference index --data my-split --encoder thumbnail
    """
    from robomme_interference_data.progress import BuildProgress
    from robomme_interference_data.retrieval.encoders import make_encoder
    from robomme_interference_data.retrieval.index import build_index

    roots = datasets_in(data)
    made = make_encoder(encoder, device=device, batch=batch)
    if threads is None:
        threads = os.cpu_count() or 1
    with BuildProgress(quiet=as_json) as progress:
        reports = build_index(roots, made, progress, camera=camera, threads=threads, force=force)
    if as_json:
        rows = [
            {
                "folder": str(report.folder),
                "frames": report.frames,
                "embedded": report.embedded,
                "typical_cosine": report.typical_cosine,
                "computed_in": report.computed_in,
                "batch": report.batch,
            }
            for report in reports
        ]
        typer.echo(json.dumps(rows))
        return
    for report in reports:
        typer.echo(f"{report.folder}: {report.frames} frames, {report.embedded} embedded now")
        if (report.computed_in, report.batch) != (made.computed_in, made.batch):
            MESSAGES.print(
                f"{report.folder} is kept, computed with {report.computed_in}, {report.batch} "
                f"images at a time; --force makes it again with {made.computed_in}, {made.batch} "
                "at a time"
            )


def retrieve(
    episode: Annotated[str, typer.Argument(help="Episode id, such as VideoRepick/test/7.")],
    k: Annotated[int, typer.Option("--k", help="Number of distractor sessions.")],
    split: SplitFolder = Path(),
    encoder: Encoder = "thumbnail",
    rule: Annotated[
        str, typer.Option(help="METHOD or METHOD/CUT, as for retrieval-score.")
    ] = "max",
    camera: Camera = "front",
    out: Annotated[Path | None, typer.Option(help="Picture to write, .png or .svg.")] = None,
    as_json: Json = False,
) -> None:
    """Tell which part of a history goes with the stored first live observation, and why.

    Needs the index of the encoder, not its weights.

    Example: robomme-interference retrieve MoveCube/test/0 --k 7 --split my-split --out why.png
    """
    from robomme_interference_data.loader import load_buffer
    from robomme_interference_data.retrieval.encoders import encoder_name, published_threshold
    from robomme_interference_data.retrieval.grade import grade, measure
    from robomme_interference_data.retrieval.report import reasons
    from robomme_interference_data.retrieval.select import Rule
    from robomme_interference_data.retrieval.selector import select

    name = encoder_name(encoder)
    settled = Rule.parse(rule).settled(published_threshold(name))
    buffer = load_buffer(episode, k, split)
    selection = select(buffer, name, settled, camera=camera)
    graded = grade(measure(buffer, name, camera), settled)
    if out is not None:
        from robomme_interference_data.retrieval.picture import draw_retrieval

        draw_retrieval(buffer, selection.choice, graded, name, camera, out)
        MESSAGES.print(f"{out} written")
    found = reasons(buffer, selection.choice, graded, camera)
    typer.echo(json.dumps(found.as_dict(), indent=2) if as_json else found.text())


def retrieval_score(
    split: SplitFolder = Path(),
    encoder: Encoder = "thumbnail",
    rules: Annotated[
        list[str],
        typer.Option(
            help="How to choose: METHOD or METHOD/CUT, several for comparison, or all. METHOD is "
            "max (released rule), mean, last, random, top32 or oracle; CUT a cosine or adaptive, "
            "left out for the encoder's own."
        ),
    ] = ["max"],  # noqa: B006 - typer copies it
    camera: Camera = "front",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for cells.csv, rows.csv (each query) and retrieval.png."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Grade retrieval on every buffer of a split, without a simulator.

    Examples:
    robomme-interference retrieval-score --split my-split

    robomme-interference retrieval-score --split my-split --rules all --out my-score
    """
    from robomme_interference_data.files import atomic_path
    from robomme_interference_data.retrieval.encoders import encoder_name, published_threshold
    from robomme_interference_data.retrieval.grade import PASS_MARK, cells, grade
    from robomme_interference_data.retrieval.report import (
        cell_table,
        grade_table,
        shown_table,
        verdict,
    )
    from robomme_interference_data.retrieval.select import parse_rules

    name = encoder_name(encoder)
    wanted = parse_rules(rules, published_threshold(name))
    opened, measured = _measured(split, name, camera, quiet=as_json)
    grades = [grade(one, rule) for rule in wanted for one in measured]
    found = list(cells(grades))
    title = f"Retrieval on {opened.name}, encoder {name}, camera {camera}"
    if len(wanted) == 1:
        title += f", rule {wanted[0]}"
    table = cell_table(found, title)
    if out is not None:
        from robomme_interference_data.retrieval.figures import draw_cells

        for one in (table, grade_table(grades, title)):
            with atomic_path(out / f"{one.name}.csv") as partial:
                partial.write_text(one.csv(), encoding="utf-8", newline="\n")
        draw_cells(found, title, out / "retrieval.png")
        MESSAGES.print(f"{out / 'cells.csv'}, rows.csv and retrieval.png written")
    if as_json:
        _print_json(
            opened,
            name,
            camera,
            {
                "buffers": len(measured),
                "rules": [str(rule) for rule in wanted],
                "pass_mark": PASS_MARK,
                "cells": table.records(),
            },
        )
        return
    typer.echo(shown_table(found, title).text())
    typer.echo(f"\n{verdict(found)}.")


def calibrate(
    split: SplitFolder = Path(),
    encoder: Encoder = "thumbnail",
    sweep: Annotated[
        tuple[float, float],
        typer.Option(help="First and last threshold to try, in steps of 0.01."),
    ] = (0.80, 0.99),
    camera: Camera = "front",
    out: Annotated[Path | None, typer.Option(help="Figure to write, .png or .svg.")] = None,
    as_json: Json = False,
) -> None:
    """Fit the cosine below which histories are cut, and show what others would give.

    The released rule: midway between the 99th percentile of the cosines across true cuts and the
    1st percentile of the lowest cosine inside each session, every stored span once.

    Example: robomme-interference calibrate --split my-split --sweep 0.30 0.99 --out cuts.png
    """
    from robomme_interference_data.retrieval.calibrate import calibrate as compute
    from robomme_interference_data.retrieval.calibrate import steps
    from robomme_interference_data.retrieval.encoders import encoder_name, published_threshold
    from robomme_interference_data.retrieval.report import calibration_text
    from robomme_interference_data.retrieval.select import Rule

    name = encoder_name(encoder)
    thresholds = steps(*sweep)
    opened, measured = _measured(split, name, camera, quiet=as_json)
    found = compute(measured, thresholds)
    rule = Rule().settled(published_threshold(name))
    own = rule.threshold(measured[0].typical)
    title = f"Threshold of {name}, camera {camera}, on {opened.name}"
    if out is not None:
        from robomme_interference_data.retrieval.figures import draw_calibration

        draw_calibration(found, own, title, out)
        MESSAGES.print(f"{out} written")
    if as_json:
        _print_json(
            opened, name, camera, {"in_use": {"rule": str(rule), "threshold": own}, **asdict(found)}
        )
    else:
        typer.echo(calibration_text(found, str(rule), own, title))


def _measured(
    folder: Path, encoder: str, camera: str, *, quiet: bool
) -> tuple["Split", list["Measured"]]:
    """Open a split and compare the embeddings of all its buffers."""
    from robomme_interference_data.loader import load_split
    from robomme_interference_data.progress import BuildProgress
    from robomme_interference_data.retrieval.grade import measure

    opened = load_split(folder)
    measured = []
    with BuildProgress(unit="buffers", quiet=quiet) as progress:
        progress.start(encoder, len(opened))
        for buffer in opened.buffers():
            measured.append(measure(buffer, encoder, camera))
            progress.advance(1)
    return opened, measured


def _print_json(split: "Split", encoder: str, camera: str, found: dict[str, Any]) -> None:
    made = {"encoder": encoder, "camera": camera}
    value = {"split": split.name, "revision": split.revision, **made, **found}
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))


def datasets_in(data: Path) -> list[Path]:
    """Return the datasets of a split, or the one dataset that a folder is.

    Raises:
        MissingFileError: The folder is neither.
    """
    if (data / INFO_PATH).is_file():
        return [data]
    both = [data / DEMONSTRATIONS, data / DISTRACTORS]
    if all((root / INFO_PATH).is_file() for root in both):
        return both
    raise MissingFileError(
        f"{data} is neither a split (with {DEMONSTRATIONS}/ and {DISTRACTORS}/) nor a dataset "
        f"(with {INFO_PATH})",
        f"Point to one, or make one: robomme-interference build all --source KIND:PATH "
        f"--out {data}",
    )
