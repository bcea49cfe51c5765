"""`index`, `retrieve`, `retrieval-score`: output, files and errors."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from support.buffer_sets import QUERIES
from support.retrieval import FRAMES, change_header, remade

from robomme_interference_data import load_buffer_set
from robomme_interference_data.retrieval import drawing, explain, select
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.methods import METHODS

Run = Callable[..., tuple[int, str, str]]

EPISODE = QUERIES[0]
CONDITIONS = ("k0", "k1", "k3", "k7")
FAMILIES = ("VideoRepick", "MoveCube", "PatternLock")


def picture(path: Path) -> tuple[int, int]:
    """Width and height of a picture that decodes."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        assert len(np.unique(frame.to_ndarray(format="rgb24").reshape(-1, 3), axis=0)) > 20
        return frame.width, frame.height


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


# --- index -------------------------------------------------------------------------------------


def test_index(own_buffers: Path, run: Run) -> None:
    places = [f"{own_buffers}/{name}/index/thumbnail" for name in ("demonstrations", "distractors")]
    code, out, err = run("index", own_buffers, "--encoder", "thumbnail", "--threads", 1)
    assert code == 0 and "frames/s" in err
    assert out.splitlines() == [
        f"{place}: {count} frames, {count} embedded now"
        for place, count in zip(places, FRAMES, strict=True)
    ]
    header = own_buffers / "distractors/index/thumbnail/index.json"
    change_header(header, computed={"in": "cuda, bfloat16", "batch": 32})
    assert (
        f"{places[1]} is kept, computed with cuda, bfloat16, batch 32"
        in run("index", own_buffers)[2]
    )
    code, out, err = run("index", own_buffers, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert [(one["folder"], one["header"]["frames"], one["embedded"]) for one in found] == [
        (place, count, 0) for place, count in zip(places, FRAMES, strict=True)
    ]


# --- retrieval-score ---------------------------------------------------------------------------


def test_only_what_is_asked_for(run: Run, indexed: Path) -> None:
    picked = ("--families", "PatternLock,MoveCube", "--conditions", "k3,no-history")
    code, out, err = run("retrieval-score", indexed, *picked)
    assert code == 0 and "2 of 4 buffers hold no lesson" in err
    lines = out.splitlines()
    rows = [line.split()[:3] for line in lines if line.split()[1:2] == ["k3"]][:3]
    assert rows == [["MoveCube", "k3", "1"], ["PatternLock", "k3", "1"], ["all", "k3", "2"]]
    code, out, _ = run("retrieval-score", indexed, *picked, "--calibrate", "--json")
    assert code == 0 and json.loads(out)["buffers"] == 2
    code, _, err = run("retrieval-score", indexed, "--conditions", "k2")
    assert code == 1 and "condition 'k2' is not in" in err


@pytest.mark.slow
def test_rules_side_by_side(run: Run, tmp_path: Path, indexed: Path) -> None:
    options = ("--rules", "oracle,last,max/-1", "--out", tmp_path)
    code, out, err = run("retrieval-score", indexed, *options)
    assert code == 0 and f"{tmp_path}/cells.csv, rows.csv and retrieval.png written" in err
    lines = out.splitlines()
    rows = [row for row in lines if row.split()[2:3] == ["3"]]
    assert [row.split()[:3] for row in rows] == [
        [rule, name, "3"] for rule in ("oracle", "last/adaptive", "max/-1") for name in CONDITIONS
    ]
    graded = rows_of(tmp_path / "cells.csv")
    assert {row["passed"] for row in graded if row["rule"] == "oracle"} == {"yes"}
    assert "oracle: 12 of 12" in lines[-1]
    found = {
        (r["rule"], r["episode_id"], r["condition"]): r for r in rows_of(tmp_path / "rows.csv")
    }
    assert len(found) == 3 * 12
    one = found["max/-1", EPISODE, "k3"]
    assert (one["start"], one["stop"], one["segments"]) == ("0", "144", "1")
    assert one["purity"] == "0.333333"  # 48 of 144
    assert picture(tmp_path / "retrieval.png") > (1000, 500)


def test_scores_as_json_and_the_same_every_time(run: Run, tmp_path: Path, indexed: Path) -> None:
    runs = [run("retrieval-score", indexed, "--json", "--out", tmp_path / name) for name in "ab"]
    assert runs[0][1] == runs[1][1]
    for name in ("cells.csv", "rows.csv", "retrieval.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    found = json.loads(runs[0][1])
    cells = {(cell["part"], cell["condition"]): cell for cell in found.pop("cells")}
    assert found == {
        "buffer_set": "buffer_set",
        "revision": load_buffer_set(indexed).revision,
        "encoder": "thumbnail",
        "camera": "front",
        "shift": "none",
        "buffers": 12,
        "left_out": 3,
        "rules": ["max/adaptive"],
        "pass_mark": 0.9,
    }
    first, every = cells["VideoRepick", "k0"], cells["all", "k0"]
    assert (every["purity"], every["false_sessions"], every["queries"]) == (1, 0, 3)
    assert first["queries"] == 1 and first["purity_low"] is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("index nowhere", "build nowhere --source KIND:PATH"),
        ("index {bare} --encoder thumbnial", "Did you mean 'thumbnail'"),
        ("index {bare} --camera side", "camera 'side'"),
        ("index {bare} --batch 0", "batch 0"),
        ("retrieval-score {bare}", "robomme-interference index {bare} --encoder thumbnail"),
        ("retrieval-score {buffer_set} --rules best", "there is no method 'best'"),
        (f"retrieve {{buffer_set}} {EPISODE} no-history", "the history is empty"),
        (f"retrieve {{buffer_set}} {EPISODE} k1 --out why.gif", "ends in"),
        ("retrieval-score {buffer_set} --calibrate --sweep 0.9 0.8", "sweep (0.9, 0.8)"),
    ],
)
def test_refusals(words: str, message: str, run: Run, indexed: Path, tiny_buffers: Path) -> None:
    places = {"buffer_set": indexed, "bare": tiny_buffers}
    code, out, err = run(*words.format(**places).split())
    assert (code, out) == (1, "")
    assert message.format(**places) in err and "Traceback" not in err
    assert not list(tiny_buffers.glob("*/index"))


# --- retrieve ----------------------------------------------------------------------------------


def test_why(run: Run, tmp_path: Path, indexed: Path) -> None:
    out_file = tmp_path / "why.png"
    words = ("retrieve", indexed, EPISODE, "k3", "--out", out_file)
    code, out, err = run(*words, "--rule", "oracle")
    assert code == 0 and f"{out_file} written" in err
    first, chosen, why, closest, lesson = out.splitlines()
    about = f"{EPISODE} under k3, front camera, rule oracle: 144 history frames, not cut"
    assert first == about
    assert chosen == f"Chosen: frames 0 to 47, of lesson {EPISODE}"
    assert why.startswith("Why: oracle takes the true lesson")
    assert closest.startswith("The first live observation is closest to frame ")
    assert "the closest other frame is frame " in closest
    assert lesson.startswith(
        "The lesson is frames 0 to 47: purity 100.0%, coverage 100.0%, 0 false"
    )
    assert picture(out_file) == (1296, 1098)


@pytest.mark.parametrize("rule", ["max/-1", "mean/-1", "last/-1"])
def test_why_is_the_reason_of_the_rule(rule: str, run: Run, indexed: Path) -> None:
    words = ("retrieve", indexed, EPISODE, "k1", "--rule", rule)
    code, out, _ = run(*words)
    method, why = rule.partition("/")[0], out.splitlines()[2]
    assert code == 0 and why.startswith(f"Why: {method} takes {METHODS[method].chooses}")
    found = json.loads(run(*words, "--json")[1])
    score, grade = found["score"], found["grade"]
    assert (score is None) == (method == "last")
    assert why.endswith(METHODS[method].chooses if score is None else f", {score:.3f}")
    if method == "max":  # one segment: its score is that of the closest frame
        assert score == found["cosine"]
    assert found["other"] is None and 0 <= found["closest"] < 80
    assert (grade["start"], grade["stop"], grade["purity"]) == (0, 80, 0.6)  # 48 of 80


def test_explanation_of_a_history_without_the_lesson(indexed: Path, tmp_path: Path) -> None:
    message = "the history holds no lesson"
    _, unit = load_buffer_set(indexed).manifest(EPISODE, "k1").sessions
    buffer = remade(indexed, [unit])
    rule = select.Rule("max", -1.0)
    measured = measure(buffer, "thumbnail")
    choice = select.choose(measured, rule)
    found = explain.explain(buffer, measured, choice, "thumbnail", "front")
    assert found.text().endswith(message)
    live = buffer.query.frame()
    drawing.draw_retrieval(buffer, measured, choice, found, live, tmp_path / "why.svg")
    assert message in (tmp_path / "why.svg").read_text()


# --- calibrate ---------------------------------------------------------------------------------


def test_calibration(run: Run, tmp_path: Path, indexed: Path) -> None:
    figure = tmp_path / "thresholds.png"
    code, out, err = run(
        "retrieval-score", indexed, "--calibrate", "--sweep", "0.1", "0.2", "--out", tmp_path
    )
    assert code == 0 and f"{figure} written" in err and figure.read_bytes().startswith(b"\x89PNG")
    assert "Fitted by the released rule: " in out and "in use (max/adaptive): " in out
    assert all(f"\n{family} " in out for family in FAMILIES)
    lines = out.splitlines()
    assert [line.split()[0] for line in lines[-11:]] == [f"{0.1 + n / 100:.2f}" for n in range(11)]
    heads = lines[-13].split()
    assert heads[1:3] == ["purity", "k0"] and heads[-2:] == ["coverage", "k7"]
    code, out, err = run("retrieval-score", indexed, "--calibrate", "--json")
    found = json.loads(out)
    assert (code, err) == (0, "") and (found["left_out"], found["rule"]) == (3, "max/adaptive")
    middle = (found["cut_percentile"] + found["lowest_percentile"]) / 2
    assert found["threshold"] == pytest.approx(middle, abs=1e-5)
    swept = [round(0.8 + n / 100, 2) for n in range(20)]
    assert [trial["threshold"] for trial in found["sweep"][::4]] == swept
    assert [one["family"] for one in found["held_out"]] == list(FAMILIES)
