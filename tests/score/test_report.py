"""The report: what it says, and that it works in a browser."""

import html
import json
import platform
import re
from dataclasses import replace
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support import scoring as made
from support.browser import open_page
from support.scoring import BASE, OWN, RETRIEVAL, cells

from robomme_interference_data.evaluate.run.plan import RunPlan
from robomme_interference_data.evaluate.run.record import Invocation
from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.plots.figures import (
    FIGURES,
    draw_figure,
    draw_figures,
)
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.report.page import write_report
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.viz.figure import open_figure, save_figure

VIDEO = "videos/MoveCube/k0 #0.mp4"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run, with one video that is there and one that is not."""
    folder = tmp_path_factory.mktemp("runs_with_a_name_that_no_browser_would_break") / "my run"
    rows = made.rows()
    place = next(i for i, r in enumerate(rows) if (r.system, r.condition) == (BASE, "k0"))
    rows[place] = replace(rows[place], video=VIDEO)
    rows[place + 1] = replace(rows[place + 1], video="videos/gone.mp4")
    starts = tuple(
        Invocation(
            command=(f"robomme-interference evaluate --out 'my run' --shard {shard}/2",),
            settings={},
            plan=RunPlan({"MoveCube/test": "0-5"}, ("k0",)),
            versions={"python": "3.12.0", "numpy": "2.2.0"},
            git="0" * 40,
            machine="x86_64",
            policy={"name": "<script>alert(1)</script>"},
            started="2026-01-31T12:00:00Z",
        )
        for shard in (1, 2)
    )
    made.write_run(folder, rows, status="complete", invocations=starts)
    (folder / VIDEO).parent.mkdir(parents=True)
    (folder / VIDEO).write_bytes(b"video")
    (folder / VIDEO).with_suffix(".html").write_text("page")
    return folder


@pytest.fixture(scope="module")
def small(run: Path) -> Score:
    return made.score(run, draws=500)


@pytest.fixture(scope="module")
def report(small: Score, run: Path) -> Path:
    out = run.parent / "score"
    write_report(small, draw_figures(small, out / "figures"), out / "report.html")
    return out / "report.html"


def episodes(found: Score, folder: Path) -> list[list[Any]]:
    """The rows of single episodes in a page."""
    write_report(found, {}, folder / "page.html")
    text = (folder / "page.html").read_text(encoding="utf-8")
    (data,) = re.findall(r'id="episode-data">(.*?)</script>', text, re.DOTALL)
    return list(json.loads(data)["rows"])


@pytest.mark.slow
def test_the_report_works_in_a_browser(report: Path, small: Score) -> None:
    with open_page() as page:

        def texts(selector: str) -> list[str]:
            found = f"[...document.querySelectorAll({json.dumps(selector)})]"
            return list(page.run(f"{found}.map(e => e.textContent)"))

        page.open(report)
        # Nothing but the file itself is asked for.
        assert page.requests() == [report.resolve().as_uri()]
        assert texts(".headline p") == [str(one) for one in headline(small, "tabletop")]
        assert texts("#grid-tabletop thead th") == [
            *("system", "no-history", "k0", "k1", "k3", "k7")
        ]
        shown = texts("#grid-tabletop tbody :is(th, td)")
        assert shown == [cell.replace("**", "") for row in small.grids[0].rows for cell in row]
        assert shown[1] == "8.3% [1.5, 35.4] n=12"
        pictures = "[...document.querySelectorAll('.picture svg')].map(p => p.clientWidth > 600)"
        assert page.run(pictures) == [True] * 8
        ids = "[...document.querySelectorAll('[id]')].map(e => e.id)"
        assert len(set(page.run(ids))) == len(page.run(ids))

        # Sorting by the rate: a click upwards, another downwards; a number, not a text.
        place = 1 + texts("#table-main thead th").index("rate")
        rates, head = (f"#table-main {cell}:nth-child({place})" for cell in ("td", "th"))
        before = texts(rates)
        page.click(f"{head} button")
        known = sorted(filter(None, before), key=lambda text: float(text.rstrip("%")))
        assert texts(rates) == [*known, *[""] * 5] != before  # five cells without a rollout
        page.click(f"{head} button")
        assert texts(rates)[0] == "58.3%"
        order = page.run(f"document.querySelector('{head}').getAttribute('aria-sort')")
        assert order == "descending"

        # Filtering a table by words.
        page.type("#table-parts input", "retrieval insertpeg")
        assert texts("#table-parts .count") == ["4 of 70 rows"]
        # An id of the CSVs finds what its name finds; a system and a condition can be chosen.
        page.run("document.querySelector('#table-parts input').value = ''")
        page.type("#table-parts input", RETRIEVAL)
        assert texts("#table-parts .count") == ["20 of 70 rows"]
        page.choose("#table-effects select[name=system]", BASE)
        page.choose("#table-effects select[name=condition]", "k7")
        page.choose("#table-effects select[name=effect]", "sessions")
        assert texts("#table-effects tbody td:nth-child(2)") == ["FrameSamp-Modul"]

        # The table of a figure is a link away, and one system is set apart from the others.
        assert texts("#figure-success-tabletop figcaption a") == ["Success by system and condition"]
        page.run("document.querySelector('#highlight').value = 'my-memory'")
        page.run("document.querySelector('#highlight').dispatchEvent(new Event('change'))")
        apart = (
            "[...document.querySelectorAll('.exploratory [data-system]:not(.dim)')]"
            ".map(e => e.dataset.system)"
        )
        assert set(page.run(apart)) == {OWN}
        # The others' names can still be read: #222 of 62% on white has a contrast of 4.5.
        names = "[...document.querySelectorAll('.dim:has(text)')]"
        strengths = page.run(f"{names}.map(e => Number(getComputedStyle(e).opacity))")
        assert strengths and min(strengths) > 0.62

        # Every episode; then only those that flip; then of one system.
        rows = "#table-episodes tbody tr"
        assert len(texts(rows)) == 36
        page.click("#flipped")
        assert len(texts(rows)) == 5 + 2
        page.type("#table-episodes input[type=search]", "Retrieval")
        assert texts(f"{rows} td:last-child") == ["k7 gained", "k7 lost"]
        page.click("#flipped")
        assert len(texts(rows)) == 12

        # The one video that is there, and the page beside it, have links that lead to them.
        page.run("document.querySelector('#table-episodes input[type=search]').select()")
        page.call("Input.insertText", text="framesamp-modul movecube")
        assert texts("#table-episodes a") == ["success", "buffer"]
        addresses = page.run("[...document.querySelectorAll('#table-episodes a')].map(a => a.href)")
        video = (report.parent.parent / "my run" / VIDEO).resolve()
        assert addresses == [video.as_uri(), video.with_suffix(".html").as_uri()]

        # On a phone nothing sticks out.
        size = {"width": 400, "height": 900, "deviceScaleFactor": 1, "mobile": True}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        assert page.run("document.documentElement.scrollWidth") == 400
        assert page.complaints() == []


@pytest.mark.slow
def test_the_report_can_be_used_by_keyboard_and_read_aloud_and_printed(report: Path) -> None:
    with open_page() as page:
        page.open(report)
        unnamed = """[...document.querySelectorAll('input, select, svg, [role], nav, button, th')]
            .filter(e => !(e.labels?.length || e.getAttribute('aria-label') || e.textContent.trim()
                           || e.getAttribute('role') === 'status'))
            .map(e => e.outerHTML.slice(0, 200))"""
        assert page.run(unnamed) == []
        # What scrolls can be reached, and headings skip no level.
        scrolling = "[...document.querySelectorAll('.wide, .picture')].map(e => e.tabIndex)"
        assert set(page.run(scrolling)) == {0}
        levels = page.run("[...document.querySelectorAll('h1,h2,h3,h4')].map(e => +e.tagName[1])")
        assert levels[0] == 1 and levels.count(1) == 1
        assert all(after - before <= 1 for before, after in pairwise(levels))
        # Letters stand out from their ground by WCAG's 4.5, on a light page and on a dark one.
        contrast = """(() => {
            const light = c => { const v = c.match(/[0-9.]+/g).slice(0, 3).map(x => x / 255)
                .map(x => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
                return 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2]; };
            const ground = e => { const c = getComputedStyle(e).backgroundColor;
                return c === 'rgba(0, 0, 0, 0)' && e.parentElement ? ground(e.parentElement) : c; };
            const letters = document.querySelectorAll('p, a, th, td, .o, .note, dt');
            return Math.min(...[...letters].map(e => {
                const a = light(getComputedStyle(e).color), b = light(ground(e));
                return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05); })); })()"""
        for scheme in ("light", "dark"):
            media = [{"name": "prefers-color-scheme", "value": scheme}]
            page.call("Emulation.setEmulatedMedia", features=media)
            assert page.run(contrast) >= 4.5
        # The keyboard sorts.
        page.run("document.querySelector('#table-main thead button').focus()")
        for kind in ("keyDown", "keyUp"):
            page.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", text="\r")
        assert page.run("document.querySelector('#table-main th').ariaSort") == "ascending"
        # On paper nothing is cut off, and controls are gone.
        page.call("Emulation.setEmulatedMedia", media="print")
        assert page.run("getComputedStyle(document.querySelector('.filters')).display") == "none"
        assert page.run("getComputedStyle(document.querySelector('.wide')).overflow") == "visible"


def test_the_report_says_how_it_was_made(report: Path, run: Path) -> None:
    text = report.read_text(encoding="utf-8")
    for shown in (
        # One line for each start of the command, to be copied as it was typed.
        "<pre><code>robomme-interference evaluate --out 'my run' --shard 1/2</code></pre>"
        "<pre><code>robomme-interference evaluate --out 'my run' --shard 2/2</code></pre>",
        # From Python there is no command: the call stands in its place.
        f"<pre><code>score(Settings(rows=(PosixPath('{run}'),), ",
        "500 draws, seeded by the simulator",
        f"Python {platform.python_version()}, robomme-interference-data ",
        *(f"{name} {metadata.version(name)}" for name in ("numpy", "pyarrow", "matplotlib")),
        '"numpy": "2.2.0",',
        sha256_file(run / "rollouts.jsonl"),
        made.REVISION,
        "those that occur in any row",
    ):
        assert shown in html.unescape(text)
    assert "<script>alert" not in text and html.escape("<script>alert(1)") in text
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", text)


def test_the_report_and_figures_are_the_same_bytes_each_time(
    report: Path, small: Score, tmp_path: Path
) -> None:
    folder = report.parent / "figures"
    # Rows of two systems under the paper's conditions.
    beyond = ("kinds", "interference", "by_evidence_kept", "ceiling", "action_error", "matrix")
    beyond += ("cost", "ability")  # the rows have no times, and are of no days
    names = [f"{kind}-tabletop" for kind in FIGURES if kind not in beyond]
    assert {path.name for path in folder.iterdir()} == {f"{name}.svg" for name in names}
    again = {name: folder / f"{name}.svg" for name in names}
    write_report(small, again, report.parent / "again.html")
    assert (report.parent / "again.html").read_bytes() == report.read_bytes()
    with open_figure() as figure:
        draw_figure("success", figure, Data(small, "tabletop"))
        save_figure(figure, path := tmp_path / "success.svg")
    assert path.read_bytes() == (folder / "success-tabletop.svg").read_bytes()
    assert b"<dc:date>" not in path.read_bytes()


def test_episodes_show_every_outcome(tmp_path: Path) -> None:
    rows = made.rows()
    again = made.changed([r for r in rows if r.condition == "k0"], model_seed=1)
    rows += made.changed(again, status="fail", success=False, error=None)
    found = episodes(made.score(made.write_csv(tmp_path / "a.csv", rows)), tmp_path)
    assert len(found) == 36
    assert found[0] == [
        *("tabletop", BASE, "MoveCube", "test/0", "easy"),
        ["success", "1/2", "success", "success", "success"],
        "k1 gained",
        [""] * 5,  # videos
        [""] * 5,  # pages of buffers
    ]
    own = {row[3]: row[5] for row in found if row[1:3] == [OWN, "MoveCube"]}
    assert own["test/2"] == ["fail", "0/1", "", "", ""]  # the other one broke
    assert own["test/5"] == ["fail", "", "", "", ""]


def test_each_rollout_has_its_video_whatever_seeds_others_have(tmp_path: Path) -> None:
    given = {  # run to rows of (episode, model seed, video)
        "a": [(0, 0, "a0.mp4")],
        "caf\udce9": [(1, 5, "b1.mp4"), (2, 5, "gone.mp4"), (2, 7, "b2.mp4"), (2, 9, "b9.mp4")],
    }
    (first,) = cells({(OWN, "k0"): "s"})
    for name, rollouts in given.items():
        rows = [
            replace(first, episode=episode, seed=episode, model_seed=model, video=video)
            for episode, model, video in rollouts
        ]
        made.write_run(tmp_path / name, rows)
        for _, _, video in rollouts:
            if video != "gone.mp4":
                (tmp_path / name / video).touch()
    found = episodes(made.score(*(tmp_path / name for name in given)), tmp_path)
    assert [row[-2] for row in found] == [["a/a0.mp4"], ["caf%E9/b1.mp4"], ["caf%E9/b2.mp4"]]
    # Of a file by itself nobody knows where its videos lie.
    alone = made.write_csv(tmp_path / "a.csv", [replace(first, video="a0.mp4")])
    assert episodes(made.score(alone), tmp_path)[0][-2] == [""]
