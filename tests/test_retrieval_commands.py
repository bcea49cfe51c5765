"""`index`, `retrieve`, `retrieval-score` and `calibrate`: what they print, write and refuse."""

import csv
import json
import os
import shutil
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import av
import factories
import numpy as np
import pyarrow.parquet as pq
import pytest

from robomme_interference_data import load_split
from robomme_interference_data.embeddings import EmbeddingIndex
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.progress import BuildProgress
from robomme_interference_data.retrieval.commands import datasets_in
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.retrieval.index import build_index

EPISODE = "VideoRepick/test/0"
GOLDEN = Path(__file__).parent / "golden" / "index"

Run = Callable[..., tuple[int, str, str]]


@cache
def indexed() -> Path:
    """A split with its index of thumbnails, made once; read-only."""
    folder = factories.copy_of_split(factories.temporary() / "indexed")
    build_index(datasets_in(folder), make_encoder("thumbnail"), BuildProgress(quiet=True))
    return folder


def picture(path: Path) -> tuple[int, int]:
    """Width and height of a picture that decodes."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        assert len(np.unique(frame.to_ndarray(format="rgb24").reshape(-1, 3), axis=0)) > 20
        return frame.width, frame.height


# --- index -----------------------------------------------------------------------------------


class TwoSums:
    """An encoder whose arithmetic is exact everywhere: sums of red and green, and a constant."""

    name = "thumbnail"
    centred = True
    batch = 8
    computed_in = "whole numbers"
    fingerprint: ClassVar[dict[str, Any]] = {"name": "two-sums", "version": 1}

    def prepare(self, images: np.ndarray) -> np.ndarray:
        sums = images[..., :2].sum(axis=(1, 2), dtype=np.int64) // 4096
        return np.concatenate([sums, np.full((len(sums), 1), 16)], axis=1).astype(np.float32)

    def features(self, prepared: np.ndarray) -> np.ndarray:
        return prepared


def test_the_files_are_the_golden_ones(tmp_path: Path) -> None:
    """A change here is a change of the format: `docs/format.md`, and the format version."""
    split = factories.copy_of_split(tmp_path / "split")
    build_index(datasets_in(split), TwoSums(), BuildProgress(quiet=True))
    written = split / "distractors" / "index" / "thumbnail"
    golden = GOLDEN / "index" / "thumbnail"
    if os.environ.get("UPDATE_GOLDEN"):
        shutil.rmtree(golden, ignore_errors=True)
        shutil.copytree(written, golden)
    assert sorted(p.name for p in written.iterdir()) == sorted(p.name for p in golden.iterdir())
    for name in ("embeddings.npy", "centre.npy"):
        assert (written / name).read_bytes() == (golden / name).read_bytes(), name
    found, expected = (pq.read_table(folder / "rows.parquet") for folder in (written, golden))
    assert found.schema.equals(expected.schema) and found.equals(expected)
    header, wanted = (json.loads((f / "index.json").read_text()) for f in (written, golden))
    for one in (header, wanted):  # the parquet writer's own version is in its bytes
        assert one["files"].pop("rows.parquet").keys() == {"bytes", "sha256"}
    assert header == wanted


def test_a_golden_index_is_read() -> None:
    header = json.loads((GOLDEN / "index" / "thumbnail" / "index.json").read_text())
    index = EmbeddingIndex(LocalFiles(GOLDEN), header["revision"], "thumbnail")
    assert index.embeddings.shape == (7 * 32, 3) and index.embeddings.dtype == np.float16
    assert index.centre is not None and index.centre[2] == 16
    assert index.camera == "observation.images.front"
    lengths = np.linalg.norm(index.embeddings.astype(float), axis=1)
    assert lengths == pytest.approx(np.ones(len(lengths)), abs=2e-3)
    assert np.array_equal(index.span(6, 30, 32), index.embeddings[-2:])


def test_the_index_command(tmp_path: Path, run: Run) -> None:
    split = factories.copy_of_split(tmp_path / "split")
    code, out, err = run("index", "--data", split, "--encoder", "thumbnail", "--threads", 1)
    assert code == 0
    assert out.splitlines() == [
        f"{split}/demonstrations/index/thumbnail: 232 frames, 232 embedded now",
        f"{split}/distractors/index/thumbnail: 224 frames, 224 embedded now",
    ]
    assert "frames/s" in err
    code, out, err = run("index", "--data", split, "--json")
    assert (code, err) == (0, "")
    rows = json.loads(out)
    assert [(row["frames"], row["embedded"]) for row in rows] == [(232, 0), (224, 0)]
    assert all(-1 < row["typical_cosine"] < 1 for row in rows)


@pytest.mark.parametrize(
    ("options", "said", "then"),
    [
        (("--data", "nowhere"), "neither a split", "build all --source"),
        (("--data", "{split}", "--encoder", "thumbnial"), "'thumbnial'", "'thumbnail'"),
        (("--data", "{split}", "--encoder", "thumbnail:x"), "no models", "--encoder thumbnail"),
        (("--data", "{split}", "--camera", "side"), "camera 'side'", "front"),
        (("--data", "{split}", "--batch", "0"), "batch=0", ""),
        (("--data", "{split}", "--threads", "0"), "threads=0", ""),
        (("--data", "{split}", "--encoder", "siglip:no/model"), "no/model", "hf download no/model"),
    ],
)
def test_index_refusals(options: tuple[str, ...], said: str, then: str, run: Run) -> None:
    if "siglip" in options[-1]:
        pytest.importorskip("transformers")
    given = [option.format(split=factories.split()) for option in options]
    code, out, err = run("index", *given)
    assert (code, out) == (1, "")
    assert said in err and then in err and "Traceback" not in err
    assert not list(factories.split().glob("*/index/thumbnail"))


# --- retrieval-score -------------------------------------------------------------------------


def test_the_table_by_family_and_k(run: Run) -> None:
    code, out, err = run("retrieval-score", "--split", indexed())
    assert code == 0 and "buffers/s" in err
    title, _, heads, rule, *rest = out.splitlines()
    assert title == "Retrieval on indexed, encoder thumbnail, camera front, rule max/adaptive"
    assert heads.split()[:3] == ["family", "k", "queries"] and set(rule) == {"-", " "}
    rows = [line.split()[:3] for line in rest[: rest.index("")]]
    queries = dict.fromkeys(factories.FAMILIES, "2") | {"all": "8"}
    order = [*load_split(indexed()).families, "all"]
    assert rows == [[family, f"k{k}", queries[family]] for family in order for k in (0, 1, 3)]
    assert out.splitlines()[-1].startswith("Cells of a family and a k that pass: max/adaptive: ")


def test_rules_side_by_side(run: Run, tmp_path: Path) -> None:
    options = ("--rules", "oracle", "last", "max/-1", "--out", tmp_path)
    code, out, err = run("retrieval-score", "--split", indexed(), *options)
    assert code == 0
    lines = out.splitlines()
    rows = lines[4 : lines.index("", 4)]
    assert [row.split()[:3] for row in rows] == [
        [rule, f"k{k}", "8"]
        for rule in ("oracle/adaptive", "last/adaptive", "max/-1")
        for k in (0, 1, 3)
    ]
    assert all(row.endswith("yes") for row in rows[:3])
    assert "oracle/adaptive: 12 of 12" in lines[-1]
    assert f"{tmp_path}/cells.csv, rows.csv and retrieval.png written" in err
    # One segment, whatever comes: all of the lesson, and every other session.
    with (tmp_path / "cells.csv").open() as file:
        whole = [row for row in csv.DictReader(file) if row["rule"] == "max/-1"]
    assert {row["coverage"] for row in whole} == {"1.000000"}
    for row in whole:
        assert float(row["false_sessions"]) == int(row["k"])
        assert (row["found_cuts"], row["false_cuts"]) == ("0", "0")
        assert int(row["true_cuts"]) == int(row["k"]) * int(row["queries"])
    with (tmp_path / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 8 * 3
    one = next(r for r in rows if (r["rule"], r["episode_id"], r["k"]) == ("max/-1", EPISODE, "3"))
    assert (one["start"], one["stop"], one["segments"]) == ("0", "116", "1")
    assert float(one["purity"]) == pytest.approx(20 / 116, abs=1e-6)
    assert picture(tmp_path / "retrieval.png") > (1000, 500)


def test_scores_as_json_and_the_same_every_time(run: Run, tmp_path: Path) -> None:
    runs = [
        run("retrieval-score", "--split", indexed(), "--json", "--out", tmp_path / name)
        for name in "ab"
    ]
    assert runs[0][1] == runs[1][1]
    for name in ("cells.csv", "rows.csv", "retrieval.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    found = json.loads(runs[0][1])
    assert (found["split"], found["encoder"], found["buffers"]) == ("indexed", "thumbnail", 24)
    assert found["camera"] == "front"
    assert found["rules"] == ["max/adaptive"] and found["pass_mark"] == 0.9
    assert found["revision"] == load_split(indexed()).revision
    cell = next(c for c in found["cells"] if (c["family"], c["k"]) == ("all", 0))
    assert cell["purity"] == 1 and cell["false_sessions"] == 0 and cell["queries"] == 8


def test_retrieval_needs_an_index(run: Run) -> None:
    split = factories.split()
    for words in (
        ("retrieval-score",),
        ("calibrate",),
        ("retrieve", EPISODE, "--k", 1),
    ):
        code, out, err = run(*words, "--split", split)
        assert (code, out) == (1, "")
        assert f"robomme-interference index --data {split} --encoder thumbnail" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("retrieval-score", "--rules", "best"), "there is no method 'best'"),
        (("retrieval-score", "--rules", "max/2"), "2.0 is no cosine"),
        (("retrieval-score", "--encoder", "clip"), "there is no encoder 'clip'"),
        (("retrieve", EPISODE, "--k", "2"), "k=2"),
        (("retrieve", "VideoRepick/test/9", "--k", "1"), "VideoRepick/test/9"),
        (("retrieve", EPISODE, "--k", "1", "--rule", "top32"), "single frames"),
        (("retrieve", EPISODE, "--k", "1", "--out", "why.gif"), "expected a name that ends in"),
        (("calibrate", "--sweep", "0.9", "0.8"), "a sweep from 0.9 to 0.8"),
        (("calibrate", "--out", "cuts.pdf"), "expected a name that ends in"),
    ],
)
def test_refusals(words: tuple[str, ...], said: str, run: Run, tmp_path: Path) -> None:
    code, out, err = run(*words, "--split", indexed())
    assert (code, out) == (1, "")
    assert said in err and "Traceback" not in err


# --- retrieve --------------------------------------------------------------------------------


def test_why(run: Run, tmp_path: Path) -> None:
    out_file = tmp_path / "why.png"
    words = ("retrieve", EPISODE, "--k", 3, "--split", indexed(), "--out", out_file)
    code, out, err = run(*words, "--rule", "oracle")
    assert code == 0 and f"{out_file} written" in err
    first, chosen, why, closest, lesson = out.splitlines()
    assert first.startswith(
        f"{EPISODE} at k=3, front camera, rule oracle/adaptive: 116 history frames, cut into"
    )
    assert chosen == f"Chosen: frames 0 to 19, of lesson {EPISODE}"
    assert why == "Why: it is the true lesson, which this rule is told"
    assert closest.startswith("What the robot sees now is closest to frame ")
    assert "the closest one outside is frame " in closest
    assert lesson == (
        "The lesson is frames 0 to 19: purity 100.0%, coverage 100.0%, 0 false sessions"
    )
    assert picture(out_file) == (1296, 1098)
    once = out_file.read_bytes()
    run(*words, "--rule", "oracle")
    assert out_file.read_bytes() == once


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        ("max/-1", "no segment long enough has a frame of a higher cosine"),
        ("mean/-1", "no segment long enough has a higher mean cosine"),
        ("last/-1", "it is the last segment that is long enough"),
        ("random/-1", "it was drawn by lot among the segments that are long enough"),
    ],
)
def test_why_is_the_reason_of_the_rule(rule: str, reason: str, run: Run) -> None:
    words = ("retrieve", EPISODE, "--k", 1, "--split", indexed(), "--rule", rule)
    code, out, _ = run(*words)
    why = out.splitlines()[2]
    assert code == 0 and why.startswith(f"Why: {reason}")
    found = json.loads(run(*words, "--json")[1])
    if rule in ("last/-1", "random/-1"):
        assert found["score"] is None and why == f"Why: {reason}"
    else:
        assert why.endswith(f", {found['score']:.3f}")
    if rule == "max/-1":  # one segment: its score is that of the closest frame
        assert found["score"] == found["cosine"]


def test_why_as_json_is_what_the_score_says(run: Run, tmp_path: Path) -> None:
    run("retrieval-score", "--split", indexed(), "--json", "--out", tmp_path)
    with (tmp_path / "rows.csv").open() as file:
        graded = {(r["episode_id"], r["k"]): r for r in csv.DictReader(file)}
    for episode, k in ((EPISODE, 0), (EPISODE, 3), ("MoveCube/test/1", 1)):
        code, out, _ = run("retrieve", episode, "--k", k, "--split", indexed(), "--json")
        found, row = json.loads(out), graded[episode, str(k)]
        assert code == 0
        for name in ("start", "stop", "segments", "false_sessions", "history_frames"):
            assert found[name] == int(row[name])
        assert found["purity"] == pytest.approx(float(row["purity"]), abs=1e-6)
        assert found["start"] <= found["closest"] < found["stop"]
        if found["other"] is not None:
            assert not found["start"] <= found["other"] < found["stop"]
            assert found["other_cosine"] <= found["cosine"]  # the released rule


# --- calibrate -------------------------------------------------------------------------------


def test_calibration(run: Run, tmp_path: Path) -> None:
    figure = tmp_path / "cuts.svg"
    options = ("--split", indexed(), "--sweep", "0.1", "0.2", "--out", figure)
    code, out, err = run("calibrate", *options)
    assert code == 0 and f"{figure} written" in err
    assert "Fitted by the released rule: " in out and "in use (max/adaptive): " in out
    for family in factories.FAMILIES:
        assert f"\n{family} " in out
    assert [line.split()[0] for line in out.splitlines()[-11:]] == [
        f"{0.1 + n / 100:.2f}" for n in range(11)
    ]
    assert figure.read_text().startswith("<?xml")
    code, out, _ = run("calibrate", "--split", indexed(), "--json")
    found = json.loads(out)
    assert found["threshold"] == pytest.approx(
        (found["cut_percentile"] + found["lowest_percentile"]) / 2, abs=1e-5
    )
    assert [point["threshold"] for point in found["sweep"][::3]] == [
        round(0.8 + n / 100, 2) for n in range(20)
    ]
    # Units return in many buffers, and cuts under k = 1 and 3: each counts once.
    rows = [m for m in load_split(indexed()).manifests() if m.k == 3]
    pairs = {(a.source, b.source) for m in rows for a, b in pairwise(m.sessions)}
    assert len(found["cuts"]) == len(pairs) <= 8 * 3
    assert len(found["lowest"]) == len({s.source for m in rows for s in m.sessions}) < 8 * 4
    assert {one["family"] for one in found["held_out"]} == set(factories.FAMILIES)
