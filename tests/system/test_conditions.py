"""Conditions beyond the paper go the whole way: the lesson last, in parts, or nowhere."""

import json
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support import worlds
from support.buffer_sets import QUERIES
from support.hub_server import HubServer
from support.publishing import UNITS, plain_cards, publish
from support.retrieval import make_index
from support.runs import run as evaluate
from support.shifted import add_shifted

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify import verify_buffer_set
from robomme_interference_data.constants import SHIFTED
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.views import live_embedding, live_frame
from robomme_interference_data.schema.shifts import SHIFTS

Login = Callable[..., None]
Run = Callable[..., tuple[int, str, str]]
QUERY = "MoveCube/test/0"
PARTS = (slice(0, 24), slice(48, 80), slice(24, 48))  # of k1: 48 frames of lesson, 32 of a unit


@pytest.fixture
def buffer_set(own_buffers: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A buffer set with buffers of kinds of conditions beyond the paper's."""
    names = ("no-history", "k0", "k1", "before-k1", "before-k3", "held-k1", "same-k1", "parts-k1")
    names += ("absent-k1",)
    code, _, err = run("build", "manifests", own_buffers, "--conditions", ",".join(names))
    assert code == 0, err
    monkeypatch.setenv(worlds.BUFFER_SET, str(own_buffers))
    return own_buffers


def test_buffers_of_other_kinds(buffer_set: Path, run: Run, tmp_path: Path) -> None:
    opened = load_buffer_set(buffer_set)
    before, plain = opened.load(QUERY, "before-k1"), opened.load(QUERY, k=1)
    lesson, unit = plain.manifest.sessions
    assert before.manifest.sessions == (unit, lesson)  # the very unit of k1
    assert (before.frames()[32:] == plain.frames()[:48]).all()
    assert opened.load(QUERY, "absent-k1").manifest.sessions == (unit,)
    assert opened.manifest(QUERY, "absent-k1").lesson_share == 0.0
    held = opened.load(QUERY, "held-k1").frames()
    assert len(held) == 80
    assert (held[48:] == held[47]).all()
    parts = opened.load(QUERY, "parts-k1").frames()
    assert (parts == np.concatenate([*(plain.frames()[s] for s in PARTS)])).all()
    for buffer in (before, opened.load(QUERY, "held-k1"), opened.load(QUERY, "parts-k1")):
        buffer.verify()
    for command in ("verify", "audit"):
        code, out, err = run(command, buffer_set)
        assert code == 0, out + err
    code, out, _ = run("list", buffer_set, "--conditions", "before-k3", "--json")
    assert [row["lesson_frames"] for row in json.loads(out)] == [48, 48, 48]
    for condition in ("before-k3", "absent-k1"):
        code, _, err = run("show", buffer_set, QUERY, condition, "--out", tmp_path / "a.png")
        assert code == 0, err


def test_retrieval_of_other_kinds(buffer_set: Path, run: Run) -> None:
    code, _, err = run("index", buffer_set, "--encoder", "thumbnail", "--workers", "1")
    assert code == 0, err
    code, out, err = run("retrieve", buffer_set, QUERY, "before-k1", "--json")
    assert code == 0, err
    assert json.loads(out)["lesson"] == [[32, 80]]
    code, out, err = run("retrieve", buffer_set, QUERY, "absent-k1", "--json")
    assert code == 0, err
    assert json.loads(out)["lesson"] == []
    code, out, err = run("retrieval-score", buffer_set, "--json")
    assert code == 0, err
    graded = {row["condition"] for row in json.loads(out)["cells"]}
    assert {"before-k1", "before-k3", "held-k1", "same-k1", "parts-k1"} < graded
    assert not graded & {"absent-k1", "no-history"}  # nothing of the lesson to be found


def test_rollouts_and_scores_of_other_kinds(buffer_set: Path, run: Run, tmp_path: Path) -> None:
    conditions = ("no-history", "k1", "before-k1", "absent-k1")
    result = evaluate(tmp_path / "run", conditions=conditions)
    told = {(row.family, row.condition): row for row in result.rows}
    rows = [told["MoveCube", name] for name in conditions]
    # Without the lesson the policy may happen on the answer: all sample episodes begin alike.
    assert [row.status for row in rows[:3]] == ["fail", "success", "success"]
    assert [(row.history_frames, row.lesson_frames) for row in rows] == [
        (0, 0),
        (80, 48),
        (80, 48),
        (32, 0),
    ]
    out = tmp_path / "score"
    code, _, err = run("score", tmp_path / "run", "--expected", "observed", "--out", out)
    assert code == 0, err
    assert "before-k1" in (out / "report.html").read_text()


OPTIONAL_DATASETS = ("raw-k1", "stale-k1", "misled-k0")
NEEDED = ("distractors-raw", "contradictions")


@pytest.mark.slow
def test_further_datasets_go_to_the_hub_and_back(
    hub: HubServer, login: Login, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At full rate, and with contradicting lessons: folders of the buffer set's repository."""
    plain_cards(monkeypatch)
    login("someone")
    root, sources = tmp_path / "buffer_set", ("--source", "sample", "--workers", "1")
    wanted = ("--split", "test", "--families", "MoveCube", "--cameras", "front")
    code, _, err = run(
        *(
            "build",
            "all",
            root,
            *sources,
            *wanted,
            "--conditions",
            ",".join(("k1", *OPTIONAL_DATASETS)),
        ),
        *("--unit-episodes", "0"),
    )
    assert code == 0, err
    for command in ("verify", "audit"):
        code, out, err = run(command, root)
        assert code == 0, out + err
    here = load_buffer_set(root)
    assert {*here.datasets} == {"demonstrations", "distractors", *NEEDED}
    lesson, unit = here.manifest(QUERY, "k1").sessions
    raw, stale = here.load(QUERY, "raw-k1"), here.load(QUERY, "stale-k1")
    assert raw.manifest.sessions[1].source == unit.source
    assert len(raw) == len(here.load(QUERY, "k1")) + 256 - 32
    fewer = here.load(QUERY, "k1").frames()[48:]
    assert (raw.frames()[48::8] == fewer).all()
    contradiction = stale.manifest.sessions[0]
    assert (contradiction.role, str(contradiction.source)) == ("contradiction", f"{QUERY}/1")
    assert stale.manifest.sessions[1:] == (lesson, unit)
    other = Query(here.datasets["contradictions"], here.datasets["contradictions"].record(0))
    assert (other.goal, other.frame().tolist()) == (raw.goal, here.query(QUERY).frame().tolist())
    assert (other.state() == here.query(QUERY).state()).all()
    assert (stale.frames()[:48] != stale.frames()[48:96]).any()

    publish(root)
    there = load_buffer_set(UNITS)
    assert there.revision == here.revision
    for name in ("k1", *OPTIONAL_DATASETS):
        buffer = there.load(QUERY, name, verify=True)
        assert (buffer.frames() == here.load(QUERY, name).frames()).all()
    assert list(verify_buffer_set(there)) == []
    copy = tmp_path / "copy"
    code, _, err = run("fetch", UNITS, "--to", copy)
    assert code == 0, err
    assert (
        load_buffer_set(copy).load(QUERY, "stale-k1", verify=True).frames() == stale.frames()
    ).all()
    code, out, err = run("verify", copy)
    assert code == 0, out + err
    code, _, err = run("fetch", UNITS, "--conditions", "k1", "--to", tmp_path / "part")
    assert code == 0, err
    assert load_buffer_set(tmp_path / "part").load(QUERY, "k1", verify=True).condition == "k1"
    assert not list((tmp_path / "part").rglob("contradictions/videos"))


@pytest.mark.slow
def test_first_views_go_to_the_hub_and_back(
    hub: HubServer, login: Login, run: Run, own_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What queries look like first under shifts: another folder of the buffer set's repository."""
    plain_cards(monkeypatch)
    login("someone")
    add_shifted(own_buffers)
    make_index(own_buffers, names=("demonstrations", "distractors", SHIFTED))
    publish(own_buffers)
    here, there, part = (
        load_buffer_set(own_buffers),
        load_buffer_set(UNITS),
        own_buffers.parent / "part",
    )
    assert there.revision == here.revision
    wanted = ("--conditions", "k0", "--families", "MoveCube", "--cameras", "front")
    code, _, err = run("fetch", UNITS, *wanted, "--index", "thumbnail", "--to", part)
    assert code == 0, err
    assert len([*(part / SHIFTED).rglob("*.mp4")]) == 1  # of the one query
    for buffer_set, queries in ((there, QUERIES), (load_buffer_set(part), (QUERY,))):
        for query, shift in product(queries, SHIFTS):
            seen, own = (one.load(query, "k0", cameras=["front"]) for one in (buffer_set, here))
            view = live_frame(buffer_set, seen, shift)
            assert (view == own.query.frame() >> SHIFTS.index(shift)).all()
            found = live_embedding(buffer_set, seen, shift, "thumbnail")
            assert (found == live_embedding(here, own, shift, "thumbnail")).all()
    assert list(verify_buffer_set(there)) == []
