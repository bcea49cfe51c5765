"""The commands of retrieval: `index`, `retrieve` and `retrieval-score`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robomme_interference_data.cli.console import (
    check_output,
    echo,
    graceful_interrupt,
    print_json,
    print_status,
)
from robomme_interference_data.cli.options import (
    AsJson,
    BufferSetFolder,
    ConditionName,
    Conditions,
    EpisodeName,
    Families,
    Picture,
    with_settings,
)
from robomme_interference_data.constants import DEMONSTRATIONS, MANIFEST_PATH
from robomme_interference_data.errors import InvalidOptionError, counted, named
from robomme_interference_data.runtime.executor import Serial, WorkersConfig, make_executor
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP, parse_shift

from .config import ENCODER_HELP, RETRIEVAL, IndexConfig

if TYPE_CHECKING:
    from .measure import Similarities

_CALIBRATION = "Calibration"

_SWEEP = (0.80, 0.99)
"""First and last threshold that a calibration grades."""

_CAMERA_HELP = "Camera whose frames are compared; default: the first."

EncoderName = Annotated[str, typer.Option(help=ENCODER_HELP, rich_help_panel=RETRIEVAL)]
CameraName = Annotated[str | None, typer.Option(help=_CAMERA_HELP, rich_help_panel=RETRIEVAL)]
ShiftText = Annotated[str, typer.Option(help=SHIFT_HELP, rich_help_panel=RETRIEVAL)]


@with_settings
def index(
    buffer_set: Annotated[
        Path, typer.Argument(help="Folder of a buffer set, or of one of its datasets.")
    ],
    config: IndexConfig,
    workers: WorkersConfig,
    as_json: AsJson = False,
) -> None:
    """Embed every stored frame but those of executions, and store them beside the data.

    An interrupted run resumes, and a valid index is kept, whichever device computed it. For
    datasets on the Hub, the command checks whether they have embeddings there.

    Examples:
    ```
    robomme-interference index my-buffers
    robomme-interference index my-buffers --encoder siglip --device cuda
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.progress import WorkProgress
    from robomme_interference_data.schema.codec import to_dict

    from .encoders import make_encoder
    from .index import build_index, datasets_to_index, look_on_hub

    roots = datasets_to_index(buffer_set)
    planned = load_buffer_set(buffer_set) if (buffer_set / MANIFEST_PATH).is_file() else None
    if planned is not None:
        planned.check_is_whole()
    image_encoder = make_encoder(config.encoder, device=config.device, batch=config.batch)
    with graceful_interrupt("Finished episodes are kept"), WorkProgress(quiet=as_json) as progress:
        reports = build_index(
            roots,
            image_encoder,
            progress,
            camera=config.camera,
            threads=(os.cpu_count() or 1) if config.threads is None else config.threads,
            force=config.force,
            executor=Serial() if workers == WorkersConfig() else make_executor(workers),
        )
    for message in look_on_hub(planned, image_encoder, reports[0].header.camera) if planned else ():
        print_status(message)
    if as_json:
        print_json([to_dict(report) for report in reports])
        return
    current = {"in": image_encoder.computed_in, "batch": image_encoder.batch}
    for report in reports:
        frames, recorded = report.header.frames, report.header.computed
        echo(f"{report.folder}: {counted(frames, 'frame')}, {report.embedded:,} embedded now")
        if recorded != current:
            print_status(
                f"{report.folder} is kept, computed with {recorded['in']}, batch "
                f"{recorded['batch']}; --force builds it again with {current['in']}, batch "
                f"{current['batch']}"
            )


def retrieve(
    buffer_set: BufferSetFolder,
    episode: EpisodeName,
    condition: ConditionName,
    encoder: EncoderName = "thumbnail",
    rule: Annotated[
        str, typer.Option(help="RULE, as in retrieval-score.", rich_help_panel=RETRIEVAL)
    ] = "max",
    camera: CameraName = None,
    shift: ShiftText = NO_SHIFT,
    out: Picture = None,
    as_json: AsJson = False,
) -> None:
    r"""Show which part of a history retrieval chooses for the first live observation, and why.

    This needs the index of the encoder, but not its weights.

    Examples:
    ```
    robomme-interference retrieve my-buffers MoveCube/test/0 k7 --out why.png
    robomme-interference retrieve my-buffers MoveCube/test/0 k7 --rule joined \
      --shift light:2
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.data.views import live_embedding, live_frame
    from robomme_interference_data.schema.codec import to_dict

    from . import drawing, encoders, explain, select
    from .measure import measure

    check_output(out)
    name = encoders.encoder_name(encoder)
    parsed = select.Rule.parse(rule, encoders.published_threshold(name))
    under, opened = parse_shift(shift), load_buffer_set(buffer_set)
    buffer = opened.load(episode, condition)
    camera = buffer.query.dataset.camera(camera)
    query = live_embedding(opened, buffer, under, name, camera)
    measured = measure(buffer, name, camera, query)
    choice = select.choose(measured, parsed)
    explanation = explain.explain(buffer, measured, choice, name, camera)
    if out is not None:
        live = live_frame(opened, buffer, under, camera)
        drawing.draw_retrieval(buffer, measured, choice, explanation, live, out)
        print_status(f"{out} written")
    if as_json:
        print_json(to_dict(explanation))
    else:
        echo(explanation.text())


def retrieval_score(
    buffer_set: BufferSetFolder,
    encoder: EncoderName = "thumbnail",
    rules: Annotated[
        list[str],
        typer.Option(
            help="Rules METHOD or METHOD/NUMBER, or all. METHOD is max (released rule), latest, "
            "joined, mean, changes, last or random, whose NUMBER is a threshold, a cosine or "
            "adaptive, by default the one published for the encoder; window, windows3 or top, "
            "whose NUMBER is one of frames; or oracle.",
            metavar="RULE,…",
            rich_help_panel=RETRIEVAL,
        ),
    ] = ["max"],  # noqa: B006 - typer copies it
    families: Families = [],  # noqa: B006
    conditions: Conditions = [],  # noqa: B006
    camera: CameraName = None,
    shift: ShiftText = NO_SHIFT,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for cells.csv, rows.csv (one row per query) and retrieval.png; of "
            "--calibrate, for thresholds.png."
        ),
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate",
            help="Instead of rules, fit the threshold below which histories are cut, and grade "
            "others.",
            rich_help_panel=_CALIBRATION,
        ),
    ] = False,
    sweep: Annotated[
        tuple[float, float],
        typer.Option(
            help="First and last threshold to grade, in steps of 0.01.",
            rich_help_panel=_CALIBRATION,
        ),
    ] = _SWEEP,
    as_json: AsJson = False,
) -> None:
    r"""Grade retrieval on every buffer with a lesson, without a simulator.

    With --calibrate, the threshold is fitted as for the released rule: the middle between the 99th
    percentile of the cosines across true borders of sessions and the 1st percentile of the lowest
    cosine inside each session.

    Examples:
    ```
    robomme-interference retrieval-score my-buffers
    robomme-interference retrieval-score my-buffers --rules all --out my-score
    robomme-interference retrieval-score my-buffers --shift light:2 \
      --conditions k7
    robomme-interference retrieval-score my-buffers --calibrate \
      --sweep 0.30 0.99
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.progress import WorkProgress
    from robomme_interference_data.schema.codec import to_dict
    from robomme_interference_data.storage.files import write_text

    from . import charts, encoders, grade, select
    from .measure import measure_all

    check_output(out)
    name = encoders.encoder_name(encoder)
    _check_calibration(rules, shift, sweep, calibrate=calibrate)
    parsed = select.parse_rules(rules, encoders.published_threshold(name))
    opened = load_buffer_set(buffer_set)
    camera = opened.datasets[DEMONSTRATIONS].camera(camera)
    with WorkProgress(unit="buffers", quiet=as_json) as progress:
        measured, left_out = measure_all(
            opened,
            name,
            camera,
            parse_shift(shift),
            families=families,
            conditions=conditions,
            progress=progress,
        )
    if left_out and not as_json:
        print_status(
            f"{left_out} of {left_out + len(measured)} buffers hold no lesson and are left out"
        )
    about: dict[str, Any] = {
        "buffer_set": opened.name,
        "revision": opened.revision,
        "encoder": name,
        "camera": camera,
        "shift": shift,
        "buffers": len(measured),
        "left_out": left_out,
    }
    if calibrate:
        _calibrate(name, measured, about, sweep, out, as_json=as_json)
        return
    grades = [grade.grade(buffer, rule) for rule in parsed for buffer in measured]
    cells = list(grade.cells(grades))
    title = f"Retrieval on {about['buffer_set']}, encoder {name}, camera {camera}"
    if shift != NO_SHIFT:
        title += f", shift {shift}"
    if len(parsed) == 1:
        title += f", rule {parsed[0]}"
    if out is not None:
        write_text(out / "cells.csv", grade.as_csv(grade.Cell, cells))
        write_text(out / "rows.csv", grade.as_csv(grade.Grade, grades))
        charts.draw_cells(cells, title, out / "retrieval.png")
        print_status(f"{out / 'cells.csv'}, rows.csv and retrieval.png written")
    if as_json:
        about |= {"rules": list(map(str, parsed)), "pass_mark": grade.PASS_MARK}
        print_json(about | {"cells": [to_dict(cell) for cell in cells]})
    else:
        echo(f"{grade.cell_table(cells, title).text()}\n\n{grade.verdict(cells)}.")


def _check_calibration(
    rules: Sequence[str], shift: str, sweep: tuple[float, float], *, calibrate: bool
) -> None:
    """Check the sweep, and that no option is set which has no effect."""
    from .calibrate import sweep_steps

    sweep_steps(*sweep)
    if not calibrate and sweep != _SWEEP:
        raise InvalidOptionError(f"{named('sweep')} has no effect without {named('calibrate')}")
    for name, changed in (("rules", rules != ["max"]), ("shift", shift != NO_SHIFT)):
        if calibrate and changed:
            raise InvalidOptionError(f"{named(name)} has no effect with {named('calibrate')}")


def _calibrate(
    name: str,
    measured: "list[Similarities]",
    about: dict[str, Any],
    sweep: tuple[float, float],
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    """Fit the threshold, print its grades, and draw them."""
    from robomme_interference_data.schema.codec import to_dict

    from . import calibrate, charts, encoders, select

    rule = select.Rule.parse("max", encoders.published_threshold(name))
    calibration = calibrate.calibrate(measured, rule, calibrate.sweep_steps(*sweep))
    title = f"Threshold of {name}, camera {about['camera']}, on {about['buffer_set']}"
    if out is not None:
        charts.draw_calibration(calibration, title, out / "thresholds.png")
        print_status(f"{out / 'thresholds.png'} written")
    if as_json:
        print_json(about | to_dict(calibration))
    else:
        echo(calibration.text(title))
