"""score as a command: options, exported rows, what a score leaves."""

import csv
import html
import json
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import factories
import pytest
import rollout_doubles
import score_rows as made
from score_rows import run

from robomme_interference_data.errors import (
    BadRowsError,
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.score.export import export
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.outputs import TABLES
from robomme_interference_data.evaluate.score.read import RELEASED_COLUMNS
from robomme_interference_data.evaluate.score.rollouts import read_rollouts
from robomme_interference_data.evaluate.score.scoring import score

Run = Callable[..., Any]


@made.needs_released
def test_score_and_export_on_the_command_line(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run(
        *("score", made.RELEASED, "--system", made.RETRIEVAL, "--against", "paper", "--out", out),
        *("--export", tmp_path / "export", "--json"),
    )
    assert done.exit_code == 0, done.output
    value = json.loads(done.stdout)
    assert value["rows"] == 1800
    assert [record["successes"] for record in value["tables"]["main"]] == [202, 201, 202, 202]
    assert f"Report: {out / 'report.html'}" in done.stderr
    names = {path.name for path in (out / "tables").glob("*.csv")}
    assert names >= {
        f"{n}.csv" for n in ["main", "family", "difficulty", "lift", "effects", "coverage"]
    }
    figures = sorted(path.name for path in (out / "figures").iterdir())
    kinds = ("difficulty", "families", "heatmap", "retrieval", "success")
    assert figures == [f"{kind}-robomme{s}" for kind in kinds for s in (".png", ".svg")]
    # The released rows come back byte for byte.
    (exported,) = (tmp_path / "export").iterdir()
    assert exported.read_bytes() == made.RELEASED.read_bytes()


def test_exported_runs_are_read_back_the_same(tmp_path: Path) -> None:
    path = made.write_parquet(tmp_path / "a.parquet", made.rows())
    common = ("--grid", "given", "--out", tmp_path / "out")
    assert run("score", path, *common, "--export", tmp_path / "export").exit_code == 0
    exported = sorted((tmp_path / "export").iterdir())
    assert [f.name for f in exported] == [
        "my-memory-tabletop_rollouts.csv",
        "perceptual-framesamp-modul-tabletop_rollouts.csv",
        "retrieval-framesamp-modul-tabletop_rollouts.csv",
    ]
    with exported[0].open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert [row["status"] for row in rows].count("error") == 1
    found = score([exported[1]], system=made.BASE, grid=Grid.GIVEN, draws=100)
    assert [cell.counts[0] for cell in found.cells] == [1, 7, 5, 3, 2]
    assert found.cells[2].counts == (5, 6, 1, 0)  # `ongoing` is a timeout
    # Their simulator comes back, too: they never stand beside the paper's rates.
    done = run(
        *("score", exported[1], "--system", made.BASE, "--against", "paper", "--json"),
        *("--grid", "given", "--out", tmp_path / "paper"),
    )
    value = json.loads(done.stdout)
    assert value["tables"]["paper"] == [] and list(value["headlines"]) == ["tabletop"]


RETRIEVED: dict[str, Any] = {
    "retrieval_model": "thumbnail/max/adaptive",
    "retrieval_selected_lesson_fraction": 0.5,
    "retrieval_selected_filler_fraction": 0.46875,
    "retrieval_selected_query_fraction": 1 / 32,
}


def test_exported_rows_are_the_same_bytes_from_csv_and_parquet(tmp_path: Path) -> None:
    kept = [made.row(made.OWN, "k0", "InsertPeg", i, letter) for i, letter in enumerate("sfte")]
    kept[1] = replace(kept[1], seed=None, difficulty=None)
    rows = [replace(r, simulator=s, **RETRIEVED) for s in ("robomme", "tabletop") for r in kept]
    # As pandas saves a column with a gap, and an author a number.
    text = made.write_csv(tmp_path / "a.csv", rows).read_text(encoding="utf-8")
    text = text.replace(",1000,", ",1000.0,").replace(",0.5,0.46875,", ",0.50,0.468750,")
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    for name, path in (
        ("csv", tmp_path / "a.csv"),
        ("parquet", made.write_parquet(tmp_path / "a.parquet", rows)),
    ):
        found = read_rollouts([path])
        assert len(export(found, tmp_path / name)) == 2
        lines = [
            *("InsertPeg,k0,0,1000,easy,success,1,100", "InsertPeg,k0,1,,,fail,0,100"),
            *("InsertPeg,k0,2,1002,medium,ongoing,0,1300", "InsertPeg,k0,3,1003,medium,error,,100"),
        ]
        for simulator, head, tail in (("robomme", "", ""), ("tabletop", ",simulator", ",tabletop")):
            file = tmp_path / name / f"{made.OWN}-{simulator}_rollouts.csv"
            expected = [
                ",".join(RELEASED_COLUMNS) + head,
                *(f"{line},thumbnail/max/adaptive,0.5,0.46875,0.03125{tail}" for line in lines),
            ]
            assert file.read_bytes() == "".join(f"{line}\r\n" for line in expected).encode()


def test_rows_of_other_episodes_than_test_ones_are_not_exported(tmp_path: Path) -> None:
    rows = made.rows()
    rows[7] = replace(rows[7], episode_split="val", seed=7)
    found = read_rollouts([made.write_csv(tmp_path / "a.csv", rows)])
    with pytest.raises(InvalidOptionError, match="1 rows are of train or val episodes"):
        export(found, tmp_path / "export")
    assert not (tmp_path / "export").exists()


def test_rows_without_a_revision_stand_beside_others_and_are_not_paired(tmp_path: Path) -> None:
    """Released rows name no revision: their buffers may be others than those of one's own runs."""
    rows = [replace(r, simulator="robomme") for r in made.rows()]
    base = [r for r in rows if r.system == made.BASE]
    retrieval = [r for r in rows if r.system == made.RETRIEVAL]
    assert len(export(read_rollouts([made.write_csv(tmp_path / "all.csv", rows)]), tmp_path)) == 3
    own = made.write_csv(tmp_path / "own.csv", base)
    other = tmp_path / f"{made.RETRIEVAL}-robomme_rollouts.csv"
    page = tmp_path / "out" / "report.html"

    def scored(*paths: Path) -> Any:
        done = run(
            *("score", *paths, "--system", made.RETRIEVAL, "--grid", "given"),
            *("--out", tmp_path / "out", "--json"),
        )
        assert done.exit_code == 0, done.output
        value = json.loads(done.stdout)
        pairs = {(r["system"], r["against_system"]) for r in value["tables"]["effects"]}
        assert all(note in done.stderr.replace("\n", " ") for note in value["notes"])
        return pairs, value["notes"]

    inside = {(made.BASE, made.BASE), (made.RETRIEVAL, made.RETRIEVAL)}
    note = (
        f"{made.RETRIEVAL} and {made.BASE} in robomme are not paired: the rows of "
        f"{made.RETRIEVAL} name no revision of a split, so their histories may differ"
    )
    for paths in ([own, other], [other, own]):
        assert scored(*paths) == (inside, [note])
        assert note in page.read_text(encoding="utf-8")
    pinned = made.write_csv(tmp_path / "retrieval.csv", retrieval)
    assert scored(own, pinned) == (inside | {(made.RETRIEVAL, made.BASE)}, [])
    assert "are not paired" not in page.read_text(encoding="utf-8")


def test_rows_of_one_system_with_and_without_a_revision_do_not_mix(tmp_path: Path) -> None:
    rows = [r for r in made.rows() if r.system == made.RETRIEVAL]
    half = made.write_csv(tmp_path / "half.csv", rows[:12])
    (other,) = export(read_rollouts([made.write_csv(tmp_path / "b.csv", rows[12:])]), tmp_path)
    for paths in ([half, other], [other, half]):
        with pytest.raises(InvalidOptionError) as raised:
            score(paths, system=made.RETRIEVAL, lenient=True)
        assert str(raised.value).startswith(
            f"some rows of {made.RETRIEVAL} in tabletop are of the split with revision "
            f"{made.REVISION}, others name no revision"
        )
    again = made.write_csv(tmp_path / "again.csv", rows[12:])
    found = json.loads(run("compare", again, other, "--system-b", made.RETRIEVAL, "--json").stdout)
    assert found["notes"] == [
        "Only one of the runs names the revision of its split of tabletop: the histories may "
        "differ."
    ]


def test_lenient_on_the_command_line(tmp_path: Path) -> None:
    lines = ["my-memory,MoveCube,k0,0,7,easy,success,1,9", "my-memory,MoveCub,k0,1,8,easy,fail,0,9"]
    path = made.released(tmp_path / "a.csv", lines)
    common = ("score", path, "--grid", "given", "--out", tmp_path / "out")
    assert isinstance(run(*common).exception, BadRowsError)
    assert not (tmp_path / "out").exists()
    done = run(*common, "--lenient")
    assert done.exit_code == 0, done.output
    assert f"left out: {path}, line 3: unknown family 'MoveCub'" in done.stderr
    assert "| my-memory | 100.0% [20.7, 100.0] n=1 |" in done.stdout
    assert isinstance(run("compare", path, path).exception, BadRowsError)
    done = run("compare", path, path, "--lenient", "--json")
    assert json.loads(done.stdout)["bad_rows"] == [1, 1]
    assert done.stderr.count("unknown family 'MoveCub'") == 2


def files(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_a_score_leaves_nothing_of_an_earlier_one_and_all_of_others(tmp_path: Path) -> None:
    out, fresh = tmp_path / "out", tmp_path / "fresh"
    rows = made.rows()
    both = [*rows, *(replace(r, simulator="robomme") for r in rows)]
    first = made.write_parquet(tmp_path / "a.parquet", both)
    second = made.write_parquet(tmp_path / "b.parquet", [r for r in rows if r.system == made.OWN])
    done = run("score", first, "--grid", "given", "--against", "paper", "--out", out)
    assert done.exit_code == 0, done.output
    assert {"tables/paper.csv", "tables/paper.md", "figures/success-robomme.png"} <= files(out)
    assert {path.stem for path in (out / "tables").iterdir()} == set(TABLES)
    others = {"tables/notes.csv", "tables/mine.md", "figures/mine.svg", "figures/success-me.png"}
    for name in (*others, "notes.txt"):
        (out / name).touch()
    for folder in (out, fresh):
        done = run("score", second, "--grid", "given", "--out", folder)
        assert done.exit_code == 0, done.output
    assert "tables/paper.csv" not in files(fresh)
    assert files(out) == files(fresh) | others | {"notes.txt"}


def test_the_report_holds_the_commands_of_the_score_and_of_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trouble").mkdir()
    monkeypatch.setenv(rollout_doubles.TROUBLE, str(tmp_path / "trouble"))
    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))

    def typed(*arguments: str | Path) -> str:
        words = ["robomme-interference", *map(str, arguments)]
        monkeypatch.setattr(sys, "argv", words)
        done = run(*words[1:])
        assert done.exit_code == 0, done.output
        return shlex.join(words)

    rollouts, out = tmp_path / "my run", tmp_path / "out"
    evaluated = typed(
        *("evaluate", "--policy", "python:rollout_doubles:make_cheat", "--conditions", "k0"),
        *("--simulator", "rollout_doubles:World", "--split", factories.split()),
        *("--episodes", "0", "--system", "mine", "--out", rollouts),
    )
    scored = typed("score", rollouts, "--grid", "given", "--lenient", "--out", out)
    page = (out / "report.html").read_text(encoding="utf-8")
    codes = [html.unescape(code) for code in re.findall("<code>(.*?)</code>", page)]
    assert codes == [scored, evaluated]


@pytest.mark.parametrize("library", ["matplotlib", "jinja2"])
def test_without_a_library_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    monkeypatch.setitem(sys.modules, library, None)
    given = ("score", path, "--grid", "given", "--out", tmp_path / "o", "--export", tmp_path / "e")
    done = run(*given)
    assert isinstance(done.exception, MissingExtraError) and library in str(done.exception)
    assert files(tmp_path) == {"a.csv"}


def test_what_cannot_be_exported_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    rows = [*made.rows(), *made.repeat(made.rows(), 3)]
    path = made.write_csv(tmp_path / "a.csv", rows)
    given = ("score", path, "--grid", "given", "--out", tmp_path / "o", "--export", tmp_path / "e")
    done = run(*given)
    assert "2 model seeds" in str(done.exception)
    assert files(tmp_path) == {"a.csv"}


@pytest.mark.parametrize(
    ("name", "error"),
    [("ret rieval", InvalidIdError), ("pi05-baseline", UnknownNameError), ("", InvalidIdError)],
)
def test_a_name_that_is_none_is_a_bad_option_not_bad_rows(
    tmp_path: Path, name: str, error: type[Exception]
) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    for given in (
        ("score", path, "--system", name, "--out", tmp_path / "out", "--lenient"),
        ("compare", path, path, "--system-b", name),
    ):
        done = run(*given)
        assert isinstance(done.exception, error) and repr(name) in str(done.exception)
    assert files(tmp_path) == {"a.csv"}
