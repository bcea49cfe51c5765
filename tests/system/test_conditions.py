"""Conditions beyond the paper and optional datasets, end to end: built, published and fetched."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import QUERIES, build, plan_again
from support.hub_server import HubServer
from support.publishing import UNITS, plain_cards, publish
from support.retrieval import make_index
from support.shifted import add_shifted

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.constants import EXECUTIONS, SHIFTED
from robomme_interference_data.data.loading import open_dataset
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.views import live_embedding, live_frame
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.schema.shifts import SHIFTS

Run = Callable[..., tuple[int, str, str]]
QUERY = "MoveCube/test/0"
FAMILIES = ("VideoRepick", "MoveCube", "PatternLock")
PARTS = (slice(0, 24), slice(48, 80), slice(24, 48))  # of k1: 48 frames of lesson, 32 of a unit


@pytest.fixture
def finish(run: Run) -> Callable[..., None]:
    """Run a command that must succeed."""

    def finish(*words: object) -> None:
        code, out, err = run(*words)
        assert code == 0, out + err

    return finish


@pytest.fixture
def _logged_in(login: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    login("someone")
    plain_cards(monkeypatch)


@pytest.mark.slow
def test_buffers_of_other_conditions(own_buffers: Path, finish: Callable[..., None]) -> None:
    names = "k1,before-k1,held-k1,same-k1,parts-k1,absent-k1"
    finish("build", own_buffers, "--only", "manifests", "--conditions", names)
    opened = load_buffer_set(own_buffers)
    buffers = {name: opened.load(QUERY, name, verify=True) for name in names.split(",")}
    plain = buffers["k1"].frames()
    lesson, unit = buffers["k1"].manifest.sessions
    assert buffers["before-k1"].manifest.sessions == (unit, lesson)
    assert (buffers["before-k1"].frames()[32:] == plain[:48]).all()
    assert buffers["absent-k1"].manifest.sessions == (unit,)
    held = buffers["held-k1"].frames()
    assert len(held) == 80 and (held[48:] == held[47]).all()
    assert (buffers["parts-k1"].frames() == np.concatenate([plain[part] for part in PARTS])).all()
    lengths = {name: buffer.manifest.lesson_frames for name, buffer in buffers.items()}
    assert lengths == dict.fromkeys(buffers, 48) | {"absent-k1": 0}
    finish("verify", own_buffers)
    finish("verify", own_buffers, "--audit", "--no-decode")


OPTIONAL_DATASETS = ("raw-k1", "stale-k1", "misled-k0")
NEEDED = ("distractors-raw", "contradictions")


@pytest.mark.slow
@pytest.mark.usefixtures("_logged_in")
def test_optional_datasets_are_published_and_fetched(
    hub: HubServer, finish: Callable[..., None], tmp_path: Path
) -> None:
    """Units at full rate and contradicting lessons are folders of the buffer set's repository."""
    root = tmp_path / "buffer_set"
    selection = "--split test --families MoveCube --cameras front --unit-episodes 0 --workers 1"
    conditions = ",".join(("k1", *OPTIONAL_DATASETS))
    words = ("--source", "sample", "--conditions", conditions, *selection.split())
    finish("build", root, *words)
    finish("verify", root)
    finish("verify", root, "--audit", "--no-decode")
    built = load_buffer_set(root)
    assert {*built.datasets} == {"demonstrations", "distractors", *NEEDED}
    lesson, unit = built.manifest(QUERY, "k1").sessions
    raw, stale = built.load(QUERY, "raw-k1"), built.load(QUERY, "stale-k1")
    assert raw.manifest.sessions[1].source == unit.source
    assert len(raw) == len(built.load(QUERY, "k1")) + 256 - 32
    assert (raw.frames()[48::8] == built.load(QUERY, "k1").frames()[48:]).all()
    contradiction = stale.manifest.sessions[0]
    assert (contradiction.role, str(contradiction.source)) == ("contradiction", f"{QUERY}/1")
    assert stale.manifest.sessions[1:] == (lesson, unit)
    dataset, query = built.datasets["contradictions"], built.query(QUERY)
    other = Query(dataset, dataset.record(0))
    assert (other.goal, other.frame().tolist()) == (raw.goal, query.frame().tolist())
    assert (other.state() == query.state()).all()
    assert (stale.frames()[:48] != stale.frames()[48:96]).any()

    publish(root)
    published, copy, part = load_buffer_set(UNITS), tmp_path / "copy", tmp_path / "part"
    assert published.revision == built.revision
    for name in ("k1", *OPTIONAL_DATASETS):
        frames = published.load(QUERY, name, verify=True).frames()
        assert (frames == built.load(QUERY, name).frames()).all()
    finish("fetch", UNITS, "--to", copy)
    finish("verify", copy)
    finish("fetch", UNITS, "--conditions", "k1", "--to", part)
    assert load_buffer_set(part).load(QUERY, "k1", verify=True).condition == "k1"
    assert not list(part.rglob("contradictions/videos"))
    finish("verify", part)


@pytest.mark.slow
@pytest.mark.usefixtures("_logged_in")
def test_executions_are_published_and_fetched(
    hub: HubServer, finish: Callable[..., None], own_buffers: Path
) -> None:
    """Only a full download has them, unless they are requested; no buffer needs them."""
    build(own_buffers, EXECUTIONS, SampleSource(size=32), split="test", families=FAMILIES)
    plan_again(own_buffers)
    publish(own_buffers)
    published = load_buffer_set(UNITS)
    published.load(QUERY, "k7", verify=True).frames()
    assert not any(path.startswith(f"{EXECUTIONS}/") for path in hub.downloads())
    made = published.datasets[EXECUTIONS]
    index = made.index_of(published.query(QUERY).episode_id)
    [first] = made.iter_frames(index, "front", 0, 1)
    assert (first == published.query(QUERY).frame()).all()
    folders = {name: own_buffers.parent / name for name in ("whole", "part", "with")}
    finish("fetch", UNITS, "--to", folders["whole"])
    finish("verify", folders["whole"])
    finish("fetch", UNITS, "--conditions", "k1", "--to", folders["part"])
    words = ("--families", "MoveCube", "--cameras", "front", "--executions")
    finish("fetch", UNITS, *words, "--to", folders["with"])
    videos = {name: len([*(one / EXECUTIONS).rglob("*.mp4")]) for name, one in folders.items()}
    assert videos == {"whole": 6, "part": 0, "with": 1}
    finish("verify", folders["part"])
    with pytest.raises(MissingFileError) as caught:
        open_dataset(load_buffer_set(folders["part"]), EXECUTIONS)
    assert caught.value.command is not None and caught.value.command.endswith(" --executions")
    finish("verify", folders["with"])


@pytest.mark.slow
@pytest.mark.usefixtures("_logged_in")
def test_views_under_shifts_are_published_and_fetched(
    hub: HubServer, finish: Callable[..., None], own_buffers: Path
) -> None:
    add_shifted(own_buffers)
    make_index(own_buffers, names=("demonstrations", "distractors", SHIFTED))
    publish(own_buffers)
    original, published = load_buffer_set(own_buffers), load_buffer_set(UNITS)
    assert published.revision == original.revision
    part = own_buffers.parent / "part"
    selection = "--conditions k0 --families MoveCube --cameras front --index thumbnail"
    finish("fetch", UNITS, *selection.split(), "--to", part)
    assert len([*(part / SHIFTED).rglob("*.mp4")]) == 1  # of the one query
    for buffer_set, queries in ((published, QUERIES), (load_buffer_set(part), (QUERY,))):
        for query in queries:
            seen, own = (one.load(query, "k0", cameras=["front"]) for one in (buffer_set, original))
            for number, shift in enumerate(SHIFTS):
                view = live_frame(buffer_set, seen, shift)
                assert (view == own.query.frame() >> number).all()
                embedding = live_embedding(buffer_set, seen, shift, "thumbnail")
                expected = live_embedding(original, own, shift, "thumbnail")
                assert (embedding == expected).all()
    assert list(verify_buffer_set(published)) == []
    finish("verify", part)
