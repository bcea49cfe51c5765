"""Cameras of any name: the default is the first by name in every command and class."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import build, plan_again
from support.made_up import MadeUpSource, picture
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import DEMONSTRATIONS
from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.evaluate import RunConfig, run_evaluation
from robomme_interference_data.retrieval.selector import Selector
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.training import HistoryDataset

DRAWER, CUPS = "OpenDrawer/test/0", "StackCups/test/0"
QUERIES = {DRAWER: (25, 5), CUPS: (7, 5)}
UNITS = {"OpenDrawer/train/0": (249, None), "StackCups/train/0": (249, None)}
CAMERAS = ("hand", "top")
WATCHER = "python:support.own_policies:Watcher"


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A buffer set of a robot whose cameras are `hand` and `top`, with an index of `hand`."""
    root = tmp_path_factory.mktemp("arm")
    for name, episodes in (("demonstrations", QUERIES), ("distractors", UNITS)):
        build(root, name, MadeUpSource(episodes, cameras=CAMERAS))
    build(root, "executions", MadeUpSource(QUERIES, cameras=CAMERAS))
    plan_again(root, ("no-history", "k0", "k1"))
    return root


def test_commands_take_the_first_camera(
    arm: Path, tmp_path: Path, run: Callable[..., tuple[int, str, str]]
) -> None:
    for words in (
        ("index", arm),
        ("index", arm, "--camera", "top"),
        ("retrieve", arm, DRAWER, "k1", "--out", tmp_path / "why.png"),
        ("retrieval-score", arm),
        ("show", arm, DRAWER, "k1", "--out", tmp_path / "strip.svg"),
    ):
        code, out, err = run(*words)
        assert code == 0, err
        if words[0] in ("retrieve", "retrieval-score"):
            assert "hand" in out and "front" not in out
    assert (arm / "distractors" / "index" / "thumbnail@hand").is_dir()


def test_classes_take_the_first_camera(arm: Path) -> None:
    buffer = load_buffer_set(arm).load(DRAWER, "k1")
    lesson = [picture(f"{DRAWER} hand", number) for number in range(5)]
    assert np.array_equal(buffer.frames()[:5], lesson)
    assert np.array_equal(buffer.frame(4), lesson[4])
    first = picture(f"{DRAWER} hand", 5)
    assert np.array_equal(buffer.query.frame(), first)
    assert buffer.embeddings("thumbnail").shape[0] == len(buffer)
    selector = Selector("thumbnail")
    assert selector.identity(buffer)["camera"] == "hand"
    assert selector.label(buffer.query.dataset).startswith("thumbnail@hand/max")
    assert len(selector.select(buffer, first))
    items = HistoryDataset(arm, ["k1"], split="test", retrieval="thumbnail", quiet=True)
    assert items.cameras == ("observation.images.hand",)


@pytest.mark.parametrize("camera", [None, "top"])
def test_retrieval_of_a_run_compares_the_first_camera(
    arm: Path, tmp_path: Path, camera: str | None
) -> None:
    config = RunConfig(
        policy=WATCHER,
        buffer_set=str(arm),
        out=tmp_path / "run",
        offline=True,
        conditions=("k1",),
        system="watcher",
        retrieval="thumbnail",
        retrieval_camera=camera,
    )
    rows = run_evaluation(config, executor=Serial()).rows
    assert [row.status for row in rows] == ["measured", "measured"], rows[0].error
    expected = f"thumbnail@{camera or 'hand'}/max"
    assert all(str(row.retrieval).startswith(expected) for row in rows)


def test_unknown_cameras_are_errors_that_name_the_option(
    arm: Path, tmp_path: Path, run: Callable[..., tuple[int, str, str]]
) -> None:
    picture = ("--out", tmp_path / "x.png")
    watcher = ("--policy", WATCHER, "--out", tmp_path / "run")
    step = ("--retrieval", "thumbnail", "--set", "retrieval_camera=nope", "--system", "x")
    for words, option in (
        (("show", arm, DRAWER, "k1", "--camera", "nope", *picture), "--camera"),
        (("show", arm, DRAWER, "k1", "--camera", "hand"), "--camera"),  # without a picture
        (("index", arm, "--camera", "nope"), "--camera"),
        (("retrieve", arm, DRAWER, "k1", "--camera", "nope"), "--camera"),
        (("retrieval-score", arm, "--camera", "nope"), "--camera"),
        (("retrieval-score", arm, "--calibrate", "--camera", "nope"), "--camera"),
        (("ceiling", arm, *step[:4]), "--set retrieval_camera"),
        (("evaluate", arm, *watcher, *step, "--offline"), "--set retrieval_camera"),
        (("evaluate", arm, *watcher), "--offline"),  # the live views are the simulator's
    ):
        code, _, err = run(*words)
        assert code == 1 and f" {option}" in err, err
    assert not (tmp_path / "run").exists() and not (tmp_path / "x.png").exists()


def test_a_policy_that_reads_a_camera_that_is_not_stored(arm: Path, tmp_path: Path) -> None:
    config = RunConfig(
        policy=WATCHER,
        policy_options=("camera=front",),
        buffer_set=str(arm),
        out=tmp_path / "run",
        offline=True,
        system="watcher",
    )
    with pytest.raises(UnknownNameError) as raised:
        run_evaluation(config)
    assert "'front'" in raised.value.message and "hand, top" in (raised.value.hint or "")


def test_without_images_the_error_names_the_setting_of_a_build(tmp_path: Path) -> None:
    build(tmp_path, "demonstrations", MadeUpSource(QUERIES, cameras=()))
    build(tmp_path, "distractors", MadeUpSource(UNITS, cameras=()))
    plan_again(tmp_path, ("k0",))
    buffer = load_buffer_set(tmp_path).load(DRAWER, "k0")
    for read in (buffer.frames, buffer.query.frame, buffer.query.dataset.camera):
        with raises(UnknownNameError):
            read()
    assert load_buffer_set(tmp_path).datasets[DEMONSTRATIONS].cameras == ()
