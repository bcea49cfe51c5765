"""The report, opened and clicked in a browser; and the figures in it."""

import html
import platform
import re
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest
import score_rows as made
from browser import open_page

from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate.score.cells import main_markdown
from robomme_interference_data.evaluate.score.episodes import episode_rows, flips
from robomme_interference_data.evaluate.score.figures import draw_figures
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.headline import headline
from robomme_interference_data.evaluate.score.looks import looks_of, spread
from robomme_interference_data.evaluate.score.report import write_report
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.evaluate.systems import PAPER_SYSTEMS, SYSTEMS
from robomme_interference_data.files import sha256_file, write_json

VIDEO = "videos/MoveCube/k0 #0.mp4"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run, with one video that is there and one that is not."""
    folder = tmp_path_factory.mktemp("runs_with_a_name_that_no_browser_would_break") / "my run"
    (folder / VIDEO).parent.mkdir(parents=True)
    (folder / VIDEO).write_bytes(b"video")
    rows = made.rows()
    place = next(i for i, r in enumerate(rows) if (r.system, r.condition) == (made.BASE, "k0"))
    rows[place] = replace(rows[place], video=VIDEO)
    rows[place + 1] = replace(rows[place + 1], video="videos/gone.mp4")
    made.write_parquet(folder / "rollouts.parquet", rows)
    record = {
        "format_version": 1,
        "command": [
            "robomme-interference evaluate --out 'my run' --shard 1/2",
            "robomme-interference evaluate --out 'my run' --shard 2/2",
        ],
        "versions": {"python": "3.12.0", "numpy": "2.2.0"},
        "split": "made-up",
        "revision": made.REVISION,
        "git": {"commit": "0" * 40, "dirty": False},
        "policy": {"name": "<script>alert(1)</script>"},
    }
    write_json(folder / "run.json", record)
    return folder


@pytest.fixture(scope="module")
def small(run: Path) -> Score:
    return score([run], grid=Grid.GIVEN, draws=500)


@pytest.fixture(scope="module")
def report(small: Score, run: Path) -> Path:
    out = run.parent / "score"
    write_report(small, draw_figures(small, out / "figures"), out / "report.html")
    return out / "report.html"


def test_the_report_works_in_a_browser(report: Path, small: Score) -> None:
    with open_page() as page:
        page.open(report)
        # Nothing but the file itself is asked for.
        assert page.requests() == [report.resolve().as_uri()]
        shown = page.run("document.querySelector('.headline').textContent")
        assert shown == headline(small, "tabletop")
        grid = (
            "[...document.querySelectorAll('#grid-tabletop tr')]"
            ".map(r => [...r.cells].map(c => c.textContent))"
        )
        markdown = [line.strip("|").split("|") for line in main_markdown(small.cells).splitlines()]
        expected = [[cell.strip(" *") for cell in line] for line in markdown if len(line) > 1]
        found = page.run(grid)
        assert found[0] == ["tabletop", "no-history", "k0", "k1", "k3", "k7"]
        assert [row[0] for row in found[1:]] == [row[0] for row in expected[2:]]
        assert found[1][1] == "8.3% [1.5, 35.4] n=12"
        images = "[...document.images].map(i => i.complete && i.naturalWidth > 100)"
        assert page.run(images) == [True] * 6

        # Sorting by the rate: a click upwards, another downwards; a number, not a text.
        rates = (
            "[...document.querySelectorAll('#table-main tbody tr')]"
            ".map(r => r.cells[4].textContent)"
        )
        before = page.run(rates)
        page.click("#table-main th:nth-child(5) button")
        upwards = page.run(rates)
        known = sorted(filter(None, before), key=lambda text: float(text.rstrip("%")))
        assert upwards == [*known, *[""] * 5]  # five cells without a rollout
        assert upwards[0] == "8.3%" and upwards != before
        page.click("#table-main th:nth-child(5) button")
        assert page.run(rates)[0] == "58.3%"
        order = "document.querySelector('#table-main th:nth-child(5)').getAttribute('aria-sort')"
        assert page.run(order) == "descending"

        # Filtering a table by words.
        page.type("#table-family input", "retrieval insertpeg")
        names = (
            "[...document.querySelectorAll('#table-family tbody tr')].map("
            "r => r.cells[1].textContent + ' ' + r.cells[3].textContent)"
        )
        assert page.run(names) == ["Retrieval-FrameSamp-Modul InsertPeg"] * 2
        assert page.run("document.querySelector('#table-family .count').textContent") == (
            "2 of 18 rows"
        )

        # Every episode; then only those that flip; then of one system.
        count = "document.querySelectorAll('#table-episodes tbody tr').length"
        assert page.run(count) == 36
        page.click("#flipped")
        assert page.run(count) == 5 + 2
        page.type("#table-episodes input[type=search]", "Retrieval")
        cells = (
            "[...document.querySelectorAll('#table-episodes tbody tr')].map("
            "r => [...r.cells].map(c => c.textContent))"
        )
        rows = page.run(cells)
        assert [(row[2], row[3], row[-1]) for row in rows] == [
            ("InsertPeg", "test/1", "k7 gained"),
            ("InsertPeg", "test/2", "k7 lost"),
        ]
        assert rows[0][5:10] == ["", "fail", "", "", "success"]
        page.click("#flipped")
        assert page.run(count) == 12

        # The one video that is there has a link that leads to it.
        page.run("document.querySelector('#table-episodes input[type=search]').select()")
        page.call("Input.insertText", text="framesamp-modul movecube")
        links = (
            "[...document.querySelectorAll('#table-episodes a')].map(a => [a.textContent, a.href])"
        )
        ((text, address),) = page.run(links)
        assert text == "success"
        assert address == (report.parent.parent / "my run" / VIDEO).resolve().as_uri()
        assert page.complaints() == []


def test_the_report_fits_a_narrow_window(report: Path) -> None:
    with open_page() as page:
        page.call(
            "Emulation.setDeviceMetricsOverride",
            **{"width": 400, "height": 900, "deviceScaleFactor": 1, "mobile": True},
        )
        page.open(report)
        assert page.run("document.documentElement.scrollWidth") == 400


def test_the_report_says_how_it_was_made(report: Path, run: Path) -> None:
    text = report.read_text(encoding="utf-8")
    for shown in (
        # One line for each shard of a joined run, to be copied as it was typed.
        "<pre><code>robomme-interference evaluate --out 'my run' --shard 1/2</code></pre>"
        "<pre><code>robomme-interference evaluate --out 'my run' --shard 2/2</code></pre>",
        # From Python there is no command: the call stands in its place.
        f"<pre><code>score([{str(run)!r}], system=None, lenient=False, grid='given', "
        "against_paper=False, draws=500)</code></pre>",
        "500 draws, seeded by the simulator",
        f"Python {platform.python_version()}, robomme-interference-data ",
        *(f"{name} {metadata.version(name)}" for name in ("numpy", "pyarrow", "matplotlib")),
        "numpy 2.2.0, python 3.12.0",
        sha256_file(run / "rollouts.parquet"),
        made.REVISION,
        "those that any of the given rows is of",
    ):
        assert shown in html.unescape(text)
    assert "<script>alert" not in text and html.escape("<script>alert(1)") in text
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", text)


def test_the_report_and_figures_are_the_same_bytes_each_time(
    report: Path, run: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    again = score([run], grid=Grid.GIVEN, draws=500)
    out = run.parent / "again"
    figures = draw_figures(again, out / "figures")
    write_report(again, figures, out / "report.html")
    assert (out / "report.html").read_bytes() == report.read_bytes()
    names = sorted(path.name for path in (report.parent / "figures").iterdir())
    assert names == sorted(path.name for path in (out / "figures").iterdir())
    kinds = ("difficulty", "families", "heatmap", "retention", "retrieval", "success")
    assert names == [f"{kind}-tabletop{suffix}" for kind in kinds for suffix in (".png", ".svg")]
    for name in names:
        one, other = (folder / "figures" / name for folder in (report.parent, out))
        assert one.read_bytes() == other.read_bytes(), name
        assert b"<dc:date>" not in one.read_bytes()


def test_a_missing_library_names_the_line_to_type(
    small: Score, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(
        MissingExtraError, match=r'pip install "robomme-interference-data\[score\]"'
    ):
        write_report(small, {}, tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


def test_where_episodes_flip() -> None:
    nan = float("nan")
    conditions = ["k0", "k1", "k3", "k7"]
    assert flips(conditions, [1, 1, 0, 1]) == "k3 lost, k7 gained"
    assert flips(conditions, [1, nan, 0, nan]) == "k3 lost"
    assert flips(conditions, [0, 0, 0, 0]) == flips([], []) == flips(["k0"], [nan]) == ""
    assert flips(conditions, [0.5, 1, 1, 0.5]) == "k1 gained, k7 lost"


def test_episode_rows_show_every_outcome(tmp_path: Path) -> None:
    rows = made.rows()
    rows += [
        replace(r, model_seed=1, status="fail", success=False, error=None)
        for r in rows
        if r.condition == "k0"
    ]
    found = score([made.write_csv(tmp_path / "a.csv", rows)], grid=Grid.GIVEN, draws=10)
    listed = list(episode_rows(found.outcomes, found.rollouts, tmp_path))
    assert len(listed) == 36
    first = listed[0]
    assert (first.system, first.episode, first.difficulty) == (made.BASE, "MoveCube/test/0", "easy")
    assert first.outcomes == {
        "no-history": "success",
        "k0": "1/2",
        "k1": "success",
        "k3": "success",
        "k7": "success",
    }
    assert first.flips == "k1 gained"
    own = {row.episode: row.outcomes for row in listed if row.system == made.OWN}
    assert own["MoveCube/test/2"] == {"no-history": "fail", "k0": "0/1"}  # the other one broke
    assert own["MoveCube/test/5"] == {"no-history": "fail"}


def test_each_rollout_has_its_video_whatever_seeds_others_have(tmp_path: Path) -> None:
    first = next(r for r in made.rows() if (r.system, r.condition) == (made.BASE, "k0"))
    given = {  # run to rows of (episode, model seed, video)
        "a": [(0, 0, "a0.mp4")],
        "b": [(1, 5, "b1.mp4"), (2, 5, "gone.mp4"), (2, 7, "b2.mp4"), (2, 9, "b9.mp4")],
    }
    for name, rollouts in given.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text('{"format_version": 1}')
        rows = [
            replace(first, episode=episode, seed=episode, model_seed=model, video=video)
            for episode, model, video in rollouts
        ]
        made.write_parquet(tmp_path / name / "rollouts.parquet", rows)
        for _, _, video in rollouts:
            if video != "gone.mp4":
                (tmp_path / name / video).touch()
    found = score([tmp_path / "a", tmp_path / "b"], grid=Grid.GIVEN, draws=10)
    listed = list(episode_rows(found.outcomes, found.rollouts, tmp_path))
    assert [row.videos for row in listed] == [{"k0": f"{v}.mp4"} for v in ("a/a0", "b/b1", "b/b2")]


def test_no_two_systems_of_the_paper_look_alike() -> None:
    looks = looks_of([system.name for system in PAPER_SYSTEMS])
    pictures = {(look.colour, look.marker, str(look.line)) for look in looks.values()}
    assert len(pictures) == len(PAPER_SYSTEMS) == 13
    # Told apart in grey, too, within a memory: by the marker.
    assert len(looks_of(["one", "two", *SYSTEMS])) == len(SYSTEMS) + 2


def test_several_systems_with_retrieval_are_stars_in_the_colours_of_their_bases() -> None:
    memories = [f"replay-{memory}" for memory in ("full", "framesamp", "window")]
    looks = looks_of([*memories, *(f"retrieval-{name}" for name in memories)])
    assert len({(look.colour, look.marker, str(look.line)) for look in looks.values()}) == 6
    for name in memories:
        assert looks[f"retrieval-{name}"].colour == looks[name].colour
        assert looks[f"retrieval-{name}"].marker == "*"
    assert looks_of(["retrieval-replay-full"])["retrieval-replay-full"].colour == "#000000"


def test_labels_are_moved_apart_by_as_little_as_need_be() -> None:
    assert spread([1.0, 5.0, 9.0], 2.0) == [1.0, 5.0, 9.0]
    # Two at 5 go to 4 and 6; the one at 7 then is too close: the three lie around their mean.
    assert spread([5.0, 5.0, 7.0], 2.0) == pytest.approx([11 / 3, 17 / 3, 23 / 3])
    assert spread([], 1.0) == []
