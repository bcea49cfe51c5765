"""The web page of a buffer: its content, its videos in Chromium, and text of untrusted data."""

import base64
import json
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import open_page
from support.buffer_sets import GOLDEN, QUERIES, copy_buffer_set
from support.damage import ROWS, edit, put, renew_header

from robomme_interference_data import Buffer, load_buffer_set
from robomme_interference_data.viz.buffer_page import RetrievedPart, write_page

QUERY = QUERIES[1]
Run = Callable[..., tuple[int, str, str]]


def page_of(out: Path, condition: str = "k7", retrieved: Any = (), root: Path = GOLDEN) -> Buffer:
    """Write the page of a buffer with both cameras; return the buffer."""
    opened = load_buffer_set(root)
    buffer = opened.load(QUERY, condition)
    live = {camera: buffer.query.frame(camera) for camera in buffer.cameras}
    assert write_page(opened, buffer, out, live, retrieved) == out.stat().st_size
    return buffer


def test_the_page_is_the_same_twice_and_holds_the_stored_files(tmp_path: Path) -> None:
    buffer = page_of(tmp_path / "a.html")
    page_of(tmp_path / "b.html")
    text = (tmp_path / "a.html").read_text()
    assert text == (tmp_path / "b.html").read_text()
    data = json.loads(re.findall(r'id="data">(.*?)</script>', text)[0])
    assert [(one["start"], one["stop"]) for one in data["sessions"]] == [
        (one.start, one.stop) for one in buffer.sessions
    ]
    files = dict(re.findall(r'id="(video-\d+)">(.*?)</script>', text))
    assert len(files) == 2 * len(buffer.sessions)
    dataset = load_buffer_set(GOLDEN).datasets["distractors"]
    stored, offset = dataset.video_of(buffer.sessions[1].entry.episode_index, "wrist")
    last = data["sessions"][1]
    assert base64.b64decode(files[last["files"][1]]) == stored.read_bytes()
    assert last["offsets"] == [offset, offset]


@pytest.mark.slow
def test_videos_play_in_chromium_frame_by_frame(tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    buffer = page_of(out, retrieved=[RetrievedPart("made/max", range(60, 70), "purity 0.0%")])
    # One script, told by its hash, may run; nothing may be fetched.
    assert "default-src 'none'" in out.read_text()
    color = """(async () => {
        await show(%d);
        return screens.map((screen) => {
            const canvas = document.createElement("canvas"), video = screen.querySelector("video");
            canvas.width = video.videoWidth; canvas.height = video.videoHeight;
            const context = canvas.getContext("2d");
            context.drawImage(video, 0, 0);
            return [...context.getImageData(0, 0, canvas.width, canvas.height).data];
        });
    })()"""
    with open_page() as page:
        page.open(out)
        for index in (0, 47, 48, 100, len(buffer) - 1, 3):
            stored = np.stack([buffer.frame(index, camera) for camera in buffer.cameras])
            deadline = time.monotonic() + 20  # a busy machine paints a frame after its event
            while True:
                pixels = page.call(
                    "Runtime.evaluate",
                    expression=color % index,
                    awaitPromise=True,
                    returnByValue=True,
                )["result"]["value"]
                painted = np.reshape(pixels, (2, 32, 32, 4))[..., :3]
                difference = np.abs(painted - stored.astype(int)).max()
                if difference <= 2 or time.monotonic() > deadline:
                    break
                time.sleep(0.1)
            assert difference <= 2, index
        page.click("#play")
        deadline = time.monotonic() + 20
        while page.run("shown") <= 4 and time.monotonic() < deadline:
            time.sleep(0.1)
        assert page.run("shown") > 4
        page.click("#play")
        assert page.run("playing") is False
        page.click("[data-frame='48']")  # the button of the first distractor
        assert page.run("shown") == 48 and "session 1" in page.run(
            "document.getElementById('where').textContent"
        )
        for width in (390, 768, 1280):  # nothing sticks out
            size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": True}
            page.call("Emulation.setDeviceMetricsOverride", **size)
            assert page.run("document.documentElement.scrollWidth") == width
        assert page.complaints() == []
        assert page.requests() == [out.resolve().as_uri()]


def test_text_of_a_data_set_is_no_markup(own_buffers: Path, tmp_path: Path) -> None:
    evil = "<script>document.title = 'owned'</script><img src=x onerror=\"document.title='owned'\">"
    edit(own_buffers / ROWS, lambda table: put(table, "goals", [[evil]] * len(table)))
    renew_header(own_buffers)
    out = tmp_path / "page.html"
    page_of(out, "k0", [RetrievedPart(evil, [0], evil)], own_buffers)
    with open_page() as page:
        page.open(out)
        assert page.run("document.title").startswith(QUERY)
        assert page.run("document.querySelector('.goal').textContent") == evil
        assert page.complaints() == []


@pytest.mark.slow
@pytest.mark.parametrize("condition", ["no-history", "k0"])
def test_pages_of_short_histories(tmp_path: Path, condition: str) -> None:
    out = tmp_path / "page.html"
    page_of(out, condition)
    with open_page() as page:
        page.open(out)
        assert page.complaints() == []


def test_the_command_writes_a_page(own_buffers: Path, tmp_path: Path, run: Run) -> None:
    root, out = copy_buffer_set(tmp_path / "indexed", own_buffers), tmp_path / "page.html"
    assert run("index", root)[0] == 0
    code, _, err = run("show", root, QUERY, "k3", "--html", out)
    assert code == 0 and "2 cameras" in err
    whole = out.read_text()
    assert "thumbnail/max/adaptive chooses" in whole
    code, _, err = run("show", root, QUERY, "k3", "--html", out, "--camera", "wrist")
    assert code == 0 and "1 camera" in err and len(out.read_text()) < len(whole)
    assert "<figcaption>front" not in out.read_text()
    shutil.rmtree(root / "demonstrations" / "index")
    code, _, err = run("show", root, QUERY, "k3", "--html", out)
    assert code == 0 and "does not show retrieval by thumbnail" in err
    assert "thumbnail/max" not in out.read_text()
    wrong = ("--html", tmp_path / "page.png")
    assert run("show", root, QUERY, "k3", "--out", tmp_path / "strip.png", *wrong)[0] == 1
    assert not (tmp_path / "strip.png").exists()
    assert run("show", root, QUERY, "k3", "--html", root / "manifests" / "page.html")[0] == 1
    assert not (tmp_path / "page.png").exists()
