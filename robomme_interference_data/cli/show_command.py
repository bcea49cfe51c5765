"""The command `show`."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robomme_interference_data.errors import InterferenceError, InvalidOptionError, counted, named
from robomme_interference_data.schema.shifts import NO_SHIFT, SHIFT_HELP, parse_shift

from .console import check_output, echo, print_json, print_status
from .options import AsJson, BufferSetFolder, EpisodeName, Picture

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from robomme_interference_data.data.buffer import Buffer
    from robomme_interference_data.data.buffer_set import BufferSet
    from robomme_interference_data.schema.shifts import Shift


def show(
    buffer_set: BufferSetFolder,
    episode: EpisodeName,
    condition: Annotated[
        str | None, typer.Argument(help="Condition, such as k3; required without --question.")
    ] = None,
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
    question: Annotated[
        bool,
        typer.Option(
            "--question", help="Show the query's question about the past, and its image with --out."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    r"""Show the sessions of one buffer as a table; as a film strip (--out) or a web page (--html).

    The web page plays the stored videos, and shows what an even sample and retrieval keep. It needs
    no other file, and is a third larger than these videos.

    Examples:
    ```
    robomme-interference show my-buffers VideoRepick/test/7 k3
    robomme-interference show my-buffers VideoRepick/test/7 k7 --out strip.png
    robomme-interference show my-buffers VideoRepick/test/7 k7 \
      --html page.html --camera front
    robomme-interference show my-buffers MoveCube/test/0 k1 --shift light:2 \
      --out strip.png
    robomme-interference show my-buffers VideoUnmask/test/0 --question \
      --out question.png
    ```
    """
    from robomme_interference_data.data.loading import load_buffer_set
    from robomme_interference_data.schema.codec import to_dict

    check_output(out, html, rerun)
    if question:
        given = {"condition": condition, "html": html, "rerun": rerun, "camera": camera}
        _check_unset(given | {"shift": None if shift == NO_SHIFT else shift})
        _show_question(load_buffer_set(buffer_set), episode, out, as_json=as_json)
        return
    if condition is None:
        raise InvalidOptionError(
            f"{named('condition')} is missing", "Such as k3.", f"list {shlex.quote(buffer_set)}"
        )
    scene_shift = parse_shift(shift)
    if out is html is rerun is None:
        _check_no_drawing({"shift": shift if scene_shift else None, "camera": camera})
    for name, path, ending in (("html", html, ".html"), ("rerun", rerun, ".rrd")):
        if path is not None and path.suffix.lower() != ending:
            raise InvalidOptionError.expected(name, str(path), f"a name that ends in {ending}")
    opened = load_buffer_set(buffer_set)
    buffer = opened.load(episode, condition)
    if out is not None:
        _draw_strip(opened, buffer, out, camera, scene_shift)
    if html is not None or rerun is not None:
        _write_videos(opened, buffer, html, rerun, camera, scene_shift)
    if as_json:
        evidence = buffer.evidence
        spans = None if evidence is None else [part.to_dict() for part in evidence]
        print_json(to_dict(buffer.manifest) | {"evidence": spans})
    else:
        _print_sessions(buffer)


def _check_unset(given: "Mapping[str, object]") -> None:
    """Check that options which do not matter for a question are left out."""
    for name, value in given.items():
        if value is not None:
            message = f"{named(name)} has no effect with {named('question')}"
            raise InvalidOptionError(message, "Leave it out.")


def _check_no_drawing(given: "Mapping[str, object]") -> None:
    """Check that options of drawings are left out if nothing is drawn."""
    for name, value in given.items():
        if value is not None:
            raise InvalidOptionError(
                f"{named(name, value)} has no effect without a file to write",
                f"Add {named('out', 'strip.png')} or {named('html', 'page.html')}, or leave it "
                "out.",
            )


def _draw_strip(
    opened: "BufferSet", buffer: "Buffer", out: Path, camera: str | None, shift: "Shift | None"
) -> None:
    from robomme_interference_data.data.views import live_frame
    from robomme_interference_data.viz.filmstrip import draw_strip

    first = next(iter(opened.cameras), None)  # of a partial copy, one that is there
    drawn = buffer.query.dataset.camera(camera or first)
    draw_strip(buffer, out, camera=drawn, live=live_frame(opened, buffer, shift, drawn))
    print_status(f"{out} written")


def _write_videos(
    opened: "BufferSet",
    buffer: "Buffer",
    html: Path | None,
    rerun: Path | None,
    camera: str | None,
    shift: "Shift | None",
) -> None:
    from robomme_interference_data.data.views import live_frame

    cameras = opened.cameras  # of a partial copy, those that are there
    if camera is not None or not cameras:
        cameras = (buffer.query.dataset.camera(camera),)
    lives = {name: live_frame(opened, buffer, shift, name) for name in cameras}
    if html is not None:
        _write_page(opened, buffer, html, lives, shift)
    if rerun is not None:
        from robomme_interference_data.viz.rerun_file import write_recording

        write_recording(buffer, rerun, lives)
        print_status(f"{rerun} written")


def _print_sessions(buffer: "Buffer") -> None:
    from robomme_interference_data.viz.tables import Columns, Table

    manifest, evidence = buffer.manifest, buffer.evidence
    columns: Columns = {
        "session": "count",
        "role": "text",
        "family": "text",
        "episode": "text",
        "frames": "text",
    }
    rows = [
        (
            number,
            session.role,
            session.family,
            str(session.source),
            f"{session.start} to {session.stop - 1}",
        )
        for number, session in enumerate(buffer.sessions)
    ]
    echo(Table("sessions", f"{manifest}: {manifest.goal}", columns, rows).text())
    if evidence:
        shown: Columns = {"part": "count", "text": "text", "session": "text", "frames": "text"}
        parts = [
            (part.span.part, part.span.text, part.session.role, f"{part.start} to {part.stop - 1}")
            for part in evidence
        ]
        title = "Frames of the buffer that show the answer"
        echo(f"\n{Table('evidence', title, shown, parts).text()}")
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
    from robomme_interference_data.data.index_layout import indexed_encoders
    from robomme_interference_data.data.views import live_embedding
    from robomme_interference_data.retrieval.encoders import published_threshold
    from robomme_interference_data.retrieval.explain import explain
    from robomme_interference_data.retrieval.measure import measure
    from robomme_interference_data.retrieval.select import Rule, choose
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
        grade = explain(buffer, measured, choice, name, cameras[0]).graded()
        retrieved.append(RetrievedPart(f"{name}/{rule}", choice.frames.tolist(), grade))
    buffer.fetch(cameras)
    size = write_page(opened, buffer, html, live, retrieved)
    print_status(f"{html} written, {size / 1e6:,.1f} MB with {counted(len(cameras), 'camera')}")


def _show_question(opened: "BufferSet", episode: str, out: Path | None, *, as_json: bool) -> None:
    from robomme_interference_data.data.questions import read_questions
    from robomme_interference_data.storage.files import atomic_path

    if out is not None and out.suffix.lower() != ".png":
        raise InvalidOptionError.expected("out", str(out), "a name that ends in .png")
    query = opened.query(episode)
    question = read_questions(opened)[query.episode_id]
    if out is not None:
        with atomic_path(out) as partial:
            partial.write_bytes(question.picture)
        print_status(f"{out} written")
    right = question.letters[question.right]
    if as_json:
        fields = {
            "goal": query.goal,
            "question": question.text,
            "options": question.lines,
            "right": right,
        }
        print_json(fields)
        return
    echo(f"goal      {query.goal}")
    echo(f"question  {question.text}")
    for number, line in enumerate(question.lines):
        title = "options" if number == 0 else ""
        echo(f"{title:8}  {line}")
    echo(f"right     {right}")
