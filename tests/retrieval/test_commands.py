"""`index`, `retrieve`, `retrieval-score` and `calibrate`: what they print, write and refuse."""

import csv
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from support.retrieval import EPISODE, remade

from robomme_interference_data import Split, load_buffer, load_split
from robomme_interference_data.retrieval import drawing, reasons, select

Run = Callable[..., tuple[int, str, str]]

CONDITIONS = ("k0", "k1", "k3", "k7")


def picture(path: Path) -> tuple[int, int]:
    """Width and height of a picture that decodes."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        assert len(np.unique(frame.to_ndarray(format="rgb24").reshape(-1, 3), axis=0)) > 20
        return frame.width, frame.height


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def opened(indexed: Path) -> tuple[Split, int]:
    """The split, and its number of queries."""
    split = load_split(indexed)
    return split, len(split.episode_ids)


# --- index -------------------------------------------------------------------------------------


def test_index(split: Path, run: Run) -> None:
    datasets = load_split(split).datasets
    names = ("demonstrations", "distractors")
    frames = [datasets[name].identity.counts.frames for name in names]
    code, out, err = run("index", split, "--encoder", "thumbnail", "--threads", 1)
    assert code == 0 and "frames/s" in err
    assert out.splitlines() == [
        f"{split}/{name}/index/thumbnail: {count} frames, {count} embedded now"
        for name, count in zip(names, frames, strict=True)
    ]
    code, out, err = run("index", split, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert [(one["header"]["frames"], one["embedded"]) for one in found] == [
        (count, 0) for count in frames
    ]
    assert all(-1 < one["header"]["typical_cosine"] < 1 for one in found)


def test_index_tells_what_it_keeps(indexed: Path, run: Run) -> None:
    path = indexed / "distractors/index/thumbnail/index.json"
    text = path.read_text()
    computed = {"computed": {"in": "cuda, bfloat16", "batch": 32}}
    path.write_text(json.dumps(json.loads(text) | computed))
    code, _, err = run("index", indexed)
    assert code == 0 and "is kept, computed with cuda, bfloat16, 32 images" in err
    path.write_text(text)


@pytest.mark.parametrize(
    ("options", "said", "then"),
    [
        (("nowhere",), "neither a split", "build all --source"),
        (("{split}", "--encoder", "thumbnial"), "'thumbnial'", "'thumbnail'"),
        (("{split}", "--encoder", "thumbnail:x"), "thumbnail:x", "siglip:ID"),
        (("{split}", "--camera", "side"), "camera 'side'", "front"),
        (("{split}", "--batch", "0"), "batch 0", ""),
        (("{split}", "--threads", "0"), "threads 0", ""),
        (("{split}", "--workers", "0"), "workers 0", ""),
        (("{split}/demonstrations",), "expected distractor units", "index SPLIT"),
    ],
)
def test_index_refusals(
    options: tuple[str, ...], said: str, then: str, run: Run, tiny_split: Path
) -> None:
    code, out, err = run("index", *[option.format(split=tiny_split) for option in options])
    assert (code, out) == (1, "")
    assert said in err and then in err and "Traceback" not in err
    assert not list(tiny_split.glob("*/index"))


# --- retrieval-score ---------------------------------------------------------------------------


def test_the_table_by_family_and_condition(run: Run, indexed: Path) -> None:
    code, out, err = run("retrieval-score", indexed)
    split, queries = opened(indexed)
    assert code == 0 and "buffers/s" in err
    assert f"{queries} of {5 * queries} buffers hold no lesson and are left out" in err
    title, _, heads, rule, *rest = out.splitlines()
    assert title == "Retrieval on split, encoder thumbnail, camera front, rule max/adaptive"
    assert heads.split()[:3] == ["family", "condition", "queries"] and set(rule) == {"-", " "}
    counts = {family: "1" for family in split.families} | {"all": str(queries)}
    rows = [line.split()[:3] for line in rest[: rest.index("")]]
    assert rows == [[family, name, counts[family]] for family in counts for name in CONDITIONS]
    assert out.splitlines()[-1].startswith("Cells of a family and a condition that pass: max/")


def test_rules_side_by_side(run: Run, tmp_path: Path, indexed: Path) -> None:
    options = ("--rules", "oracle", "last,max/-1", "--out", tmp_path)
    code, out, err = run("retrieval-score", indexed, *options)
    _, queries = opened(indexed)
    assert code == 0
    lines = out.splitlines()
    rows = lines[4 : lines.index("", 4)]
    assert [row.split()[:3] for row in rows] == [
        [rule, name, str(queries)]
        for rule in ("oracle/adaptive", "last/adaptive", "max/-1")
        for name in CONDITIONS
    ]
    assert all(row.endswith("yes") for row in rows[:4])
    assert f"oracle/adaptive: {4 * queries} of {4 * queries}" in lines[-1]
    assert f"{tmp_path}/cells.csv, rows.csv and retrieval.png written" in err
    # One segment, whatever comes: all of the lesson, and every other session.
    whole = [row for row in rows_of(tmp_path / "cells.csv") if row["rule"] == "max/-1"]
    assert {row["coverage"] for row in whole} == {"1.000000"}
    for row in whole:
        k = int(row["condition"].removeprefix("k"))
        assert float(row["false_sessions"]) == k
        assert (row["found_cuts"], row["false_cuts"]) == ("0", "0")
        assert int(row["true_cuts"]) == k * int(row["queries"])
    rows = rows_of(tmp_path / "rows.csv")
    assert len(rows) == 3 * queries * 4
    one = next(
        r for r in rows if (r["rule"], r["episode_id"], r["condition"]) == ("max/-1", EPISODE, "k3")
    )
    frames = len(load_buffer(EPISODE, "k3", split=indexed))
    assert (one["start"], one["stop"], one["segments"]) == ("0", str(frames), "1")
    assert float(one["purity"]) == pytest.approx((frames - 96) / frames, abs=1e-6)
    assert picture(tmp_path / "retrieval.png") > (1000, 500)


def test_scores_as_json_and_the_same_every_time(run: Run, tmp_path: Path, indexed: Path) -> None:
    runs = [run("retrieval-score", indexed, "--json", "--out", tmp_path / name) for name in "ab"]
    assert runs[0][1] == runs[1][1]
    for name in ("cells.csv", "rows.csv", "retrieval.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    split, queries = opened(indexed)
    found = json.loads(runs[0][1])
    assert (found["split"], found["encoder"], found["camera"]) == ("split", "thumbnail", "front")
    assert (found["buffers"], found["left_out"]) == (4 * queries, queries)
    assert found["rules"] == ["max/adaptive"] and found["pass_mark"] == 0.9
    assert found["revision"] == split.revision
    cell = next(c for c in found["cells"] if (c["family"], c["condition"]) == ("all", "k0"))
    assert cell["purity"] == 1 and cell["false_sessions"] == 0 and cell["queries"] == queries
    first = found["cells"][0]
    assert first["queries"] == 1 and first["purity_low"] is None


def test_retrieval_needs_an_index(run: Run, tiny_split: Path) -> None:
    for words in (
        ("retrieval-score", tiny_split),
        ("calibrate", tiny_split),
        ("retrieve", EPISODE, "k1", "--split", tiny_split),
    ):
        code, out, err = run(*words)
        assert (code, out) == (1, "")
        assert f"robomme-interference index {tiny_split} --encoder thumbnail" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("retrieval-score", "{split}", "--rules", "best"), "there is no method 'best'"),
        (("retrieval-score", "{split}", "--rules", "max/2"), "cut of max 2.0"),
        (("retrieval-score", "{split}", "--encoder", "clip"), "there is no encoder 'clip'"),
        (("retrieve", EPISODE, "k2", "--split", "{split}"), "condition 'k2'"),
        (("retrieve", EPISODE, "no-history", "--split", "{split}"), "the history is empty"),
        (("retrieve", "VideoRepick/test/9", "k1", "--split", "{split}"), "VideoRepick/test/9"),
        (("retrieve", EPISODE, "k1", "--split", "{split}", "--rule", "top32"), "single frames"),
        (("retrieve", EPISODE, "k1", "--split", "{split}", "--out", "why.gif"), "ends in"),
        (("calibrate", "{split}", "--sweep", "0.9", "0.8"), "sweep (0.9, 0.8)"),
        (("calibrate", "{split}", "--out", "cuts.pdf"), "ends in"),
    ],
)
def test_refusals(words: tuple[str, ...], said: str, run: Run, indexed: Path) -> None:
    code, out, err = run(*[word.format(split=indexed) for word in words])
    assert (code, out) == (1, "")
    assert said in err and "Traceback" not in err


# --- retrieve ----------------------------------------------------------------------------------


def test_why(run: Run, tmp_path: Path, indexed: Path) -> None:
    out_file = tmp_path / "why.png"
    words = ("retrieve", EPISODE, "k3", "--split", indexed, "--out", out_file)
    code, out, err = run(*words, "--rule", "oracle")
    assert code == 0 and f"{out_file} written" in err
    buffer = load_buffer(EPISODE, "k3", split=indexed)
    first, chosen, why, closest, lesson = out.splitlines()
    assert first.startswith(
        f"{EPISODE} under k3, front camera, rule oracle/adaptive: {len(buffer)} history frames, cut"
    )
    last = buffer.sessions[0].stop - 1
    assert chosen == f"Chosen: frames 0 to {last}, of lesson {EPISODE}"
    assert why.startswith("Why: oracle takes the true lesson")
    assert closest.startswith("What the robot sees now is closest to frame ")
    assert "the closest one outside is frame " in closest
    assert lesson == (
        f"The lesson is frames 0 to {last}: purity 100.0%, coverage 100.0%, 0 false sessions"
    )
    assert picture(out_file) == (1296, 1098)


@pytest.mark.parametrize("rule", ["max/-1", "mean/-1", "last/-1", "random/-1"])
def test_why_is_the_reason_of_the_rule(rule: str, run: Run, indexed: Path) -> None:
    words = ("retrieve", EPISODE, "k1", "--split", indexed, "--rule", rule)
    code, out, _ = run(*words)
    method = rule.partition("/")[0]
    why = out.splitlines()[2]
    assert code == 0 and why.startswith(f"Why: {method} takes {select.METHODS[method]}")
    found = json.loads(run(*words, "--json")[1])
    if method in ("last", "random"):
        assert found["score"] is None and why.endswith(select.METHODS[method])
    else:
        assert why.endswith(f", {found['score']:.3f}")
    if method == "max":  # one segment: its score is that of the closest frame
        assert found["score"] == found["cosine"]


def test_why_as_json_is_what_the_score_says(run: Run, tmp_path: Path, indexed: Path) -> None:
    run("retrieval-score", indexed, "--json", "--out", tmp_path)
    graded = {(r["episode_id"], r["condition"]): r for r in rows_of(tmp_path / "rows.csv")}
    for episode, condition in ((EPISODE, "k0"), (EPISODE, "k3"), ("MoveCube/test/0", "k1")):
        code, out, _ = run("retrieve", episode, condition, "--split", indexed, "--json")
        found, row = json.loads(out), graded[episode, condition]
        grade = found["grade"]
        assert code == 0 and (grade["episode_id"], grade["condition"]) == (episode, condition)
        for name in ("start", "stop", "segments", "false_sessions", "history_frames"):
            assert grade[name] == int(row[name])
        assert grade["purity"] == pytest.approx(float(row["purity"]), abs=1e-6)
        assert grade["start"] <= found["closest"] < grade["stop"]
        if found["other"] is not None:
            assert not grade["start"] <= found["other"] < grade["stop"]
            assert found["other_cosine"] <= found["cosine"]  # the released rule


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ([1, 0], "lesson is frames 32 to 79: purity 60.0%, coverage 100.0%, 1 false session"),
        ([1], "the history holds no lesson"),
    ],
    ids=["second", "absent"],
)
def test_why_wherever_the_lesson_lies(
    order: list[int], said: str, indexed: Path, tmp_path: Path
) -> None:
    planned = load_buffer(EPISODE, "k1", split=indexed)
    buffer = remade(planned, [planned.manifest.sessions[number] for number in order])
    rule = select.Rule("max", -1.0)
    measured = select.measure(buffer, "thumbnail")
    choice = select.choose(measured, rule)
    found = reasons.reasons(buffer, measured, choice, rule, "thumbnail", "front")
    assert found.text().endswith(said)
    drawing.draw_retrieval(buffer, measured, choice, found, tmp_path / "why.svg")
    assert said.rpartition(": ")[2] in (tmp_path / "why.svg").read_text()


# --- calibrate ---------------------------------------------------------------------------------


def test_calibration(run: Run, tmp_path: Path, indexed: Path) -> None:
    figure = tmp_path / "cuts.svg"
    code, out, err = run("calibrate", indexed, "--sweep", "0.1", "0.2", "--out", figure)
    split, queries = opened(indexed)
    assert code == 0 and f"{figure} written" in err
    assert "Fitted by the released rule: " in out and "in use (max/adaptive): " in out
    for family in split.families:
        assert f"\n{family} " in out
    lines = out.splitlines()
    assert [line.split()[0] for line in lines[-11:]] == [f"{0.1 + n / 100:.2f}" for n in range(11)]
    heads = lines[-13].split()
    assert heads[1:3] == ["purity", "k0"] and heads[-2:] == ["coverage", "k7"]
    assert figure.read_text().startswith("<?xml")
    code, out, err = run("calibrate", indexed, "--json")
    found = json.loads(out)
    assert (code, err) == (0, "") and found["left_out"] == queries
    assert found["in_use"]["rule"] == "max/adaptive"
    assert found["threshold"] == pytest.approx(
        (found["cut_percentile"] + found["lowest_percentile"]) / 2, abs=1e-5
    )
    assert [trial["threshold"] for trial in found["sweep"][::4]] == [
        round(0.8 + n / 100, 2) for n in range(20)
    ]
    # Units return in many buffers, and cuts under several conditions: each counts once.
    rows = list(split.manifests(condition="k7"))
    pairs = {(a.source, b.source) for m in rows for a, b in pairwise(m.sessions)}
    assert len(found["cuts"]) == len(pairs)
    assert len(found["lowest"]) == len({s.source for m in rows for s in m.sessions})
    assert {one["family"] for one in found["held_out"]} == set(split.families)
