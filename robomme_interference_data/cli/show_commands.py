"""The commands `show` and `question`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.errors import InterferenceError, InvalidOptionError, counted
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP, parse_shift

from .console import check_output, echo, print_json, print_status
from .options import AsJson, BufferSetFolder, ConditionName, Picture, QueryName

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from robomme_interference_data.data.buffer import Buffer
    from robomme_interference_data.data.buffer_set import BufferSet
    from robomme_interference_data.schema.shifts import Shift


def show(
    buffer_set: BufferSetFolder,
    episode: QueryName,
    condition: ConditionName,
    out: Picture = None,
    html: Annotated[
        Path | None, typer.Option(help="Web page to write, with the videos in it, .html.")
    ] = None,
    rerun: Annotated[
        Path | None, typer.Option(help="Recording for the Rerun viewer to write, .rrd.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(help="Camera to show; default: the first in --out, all in other files."),
    ] = None,
    shift: Annotated[str, typer.Option(help=f"{SHIFT_HELP} For files only.")] = NO_SHIFT,
    as_json: AsJson = False,
) -> None:
    """Show the sessions of one buffer as a table; as a film strip (--out) or a web page (--html).

    The web page plays the stored videos, and shows what an even sample and retrieval keep. It needs
    no other file, and takes up to 18 KB per frame and camera of 256 × 256 pixels.

    Examples:
    ```
    robomme-interference show my-buffers VideoRepick/test/7 k3
    robomme-interference show my-buffers VideoRepick/test/7 k7 --out strip.png
    robomme-interference show my-buffers VideoRepick/test/7 k7 --html page.html --camera front
    robomme-interference show my-buffers MoveCube/test/0 k1 --shift light:2 --out strip.png
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.data.views import live_frame
    from robomme_interference_data.schema.codec import to_dict
    from robomme_interference_data.viz.tables import Table

    check_output(out, html, rerun)
    for option, path, ending in (("--html", html, ".html"), ("--rerun", rerun, ".rrd")):
        if path is not None and path.suffix.lower() != ending:
            raise InvalidOptionError.expected(option, str(path), f"a name that ends in {ending}")
    scene_shift = parse_shift(shift)
    for name, given in (("shift", scene_shift and shift), ("camera", camera)):
        if given is not None and out is html is rerun is None:
            raise InvalidOptionError(
                f"--{name} {given} has no effect without a file to write",
                f"Add --out strip.png or --html page.html, or omit --{name}.",
            )
    opened = load_buffer_set(buffer_set)
    buffer = opened.load(episode, condition)
    if out is not None:
        from robomme_interference_data.viz.filmstrip import draw_strip

        first = next(iter(opened.cameras), None)  # of a partial copy, one that is there
        drawn = buffer.query.dataset.camera(camera or first)
        live = live_frame(opened, buffer, scene_shift, drawn)
        draw_strip(buffer, out, camera=drawn, live=live)
        print_status(f"{out} written")
    if html is not None or rerun is not None:
        cameras = opened.cameras  # of a partial copy, those that are there
        if camera is not None or not cameras:
            cameras = (buffer.query.dataset.camera(camera),)
        lives = {name: live_frame(opened, buffer, scene_shift, name) for name in cameras}
        if html is not None:
            _write_page(opened, buffer, html, lives, scene_shift)
        if rerun is not None:
            from robomme_interference_data.viz.rerun_file import write_recording

            write_recording(buffer, rerun, lives)
            print_status(f"{rerun} written")
    manifest, evidence = buffer.manifest, buffer.evidence
    if as_json:
        spans = None if evidence is None else [one.to_dict() for one in evidence]
        print_json(to_dict(manifest) | {"evidence": spans})
        return
    table = Table(
        "sessions",
        f"{manifest}: {manifest.goal}",
        {"session": "count", "role": "text", "family": "text", "episode": "text", "frames": "text"},
        [
            (number, one.role, one.family, str(one.source), f"{one.start} to {one.stop - 1}")
            for number, one in enumerate(buffer.sessions)
        ],
    )
    echo(table.text())
    if evidence:
        answers = Table(
            "evidence",
            "Frames of the buffer that show the answer",
            {"part": "count", "text": "text", "session": "text", "frames": "text"},
            [
                (one.span.part, one.span.text, one.session.role, f"{one.start} to {one.stop - 1}")
                for one in evidence
            ],
        )
        echo(f"\n{answers.text()}")
    echo(
        f"\n{len(buffer)} history frames; {manifest.lesson_share:.0%} of an even 32-frame sample "
        "are of the lesson"
    )


def _write_page(
    opened: "BufferSet",
    buffer: "Buffer",
    html: Path,
    live: "Mapping[str, NDArray[np.uint8]]",
    shift: "Shift | None",
) -> None:
    """Write the page of a buffer, with what retrieval chooses by each encoder that has an index."""
    from robomme_interference_data.constants import DISTRACTORS
    from robomme_interference_data.data.embeddings import indexed_encoders
    from robomme_interference_data.data.views import live_embedding
    from robomme_interference_data.retrieval.encoders import published_threshold
    from robomme_interference_data.retrieval.explain import explain
    from robomme_interference_data.retrieval.select import Rule, choose, measure
    from robomme_interference_data.viz.buffer_page import RetrievedPart, write_page

    cameras, retrieved = tuple(live), []
    encoders = indexed_encoders(opened.datasets[DISTRACTORS], cameras[0]) if len(buffer) else []
    for name in encoders:
        try:
            rule = Rule.parse("max", published_threshold(name))
            query = live_embedding(opened, buffer, shift, name, cameras[0])
            measured = measure(buffer, name, cameras[0], query)
        except InterferenceError as error:  # such as another dataset without these embeddings
            print_status(f"The page does not show retrieval by {name}: {error.message}")
            continue
        choice = choose(measured, rule)
        grade = explain(buffer, measured, choice, rule, name, cameras[0]).graded()
        retrieved.append(RetrievedPart(f"{name}/{rule}", choice.frames.tolist(), grade))
    buffer.fetch(cameras)
    size = write_page(opened, buffer, html, live, retrieved)
    print_status(f"{html} written, {size / 1e6:,.1f} MB with {counted(len(cameras), 'camera')}")


def show_question(
    buffer_set: BufferSetFolder,
    episode: QueryName,
    out: Annotated[Path | None, typer.Option(help="Image to write, .png.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show the question about the past of one query, and its image with --out.

    Example:
    ```
    robomme-interference question my-buffers VideoUnmask/test/0 --out question.png
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.data.questions import read_questions
    from robomme_interference_data.storage.files import atomic_path

    check_output(out)
    if out is not None and out.suffix.lower() != ".png":
        raise InvalidOptionError.expected("--out", str(out), "a name that ends in .png")
    opened = load_buffer_set(buffer_set)
    query = opened.query(episode)
    question = read_questions(opened)[query.episode_id]
    if out is not None:
        with atomic_path(out) as partial:
            partial.write_bytes(question.picture)
        print_status(f"{out} written")
    fields = {
        "goal": query.goal,
        "question": question.text,
        "options": question.lines,
        "right": question.letters[question.right],
    }
    if as_json:
        print_json(fields)
        return
    for name, text in fields.items():
        lines = text if isinstance(text, tuple) else (text,)
        echo("\n".join(f"{name if not n else '':8}  {line}" for n, line in enumerate(lines)))
