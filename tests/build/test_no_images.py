"""A buffer set without images, beside the same one with images."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.cards.dataset_facts import buffer_set_facts
from robomme_interference_data.cli.main import app
from robomme_interference_data.evaluate.ceiling import ceiling
from robomme_interference_data.evaluate.run.config import CeilingConfig

Run = Callable[..., tuple[int, str, str]]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two queries with k0 and k1, without images and with those of the front camera."""
    made = []
    for cameras in ("none", "front"):
        made.append(tmp_path_factory.mktemp(cameras) / "set")
        command = (
            *("build", str(made[-1]), "--source", "sample", "--split", "test"),
            *("--episodes", "0", "--unit-episodes", "0", "--families", "MoveCube,PatternLock"),
            *("--conditions", "k0,k1", "--cameras", cameras),
        )
        assert not CliRunner().invoke(app, command).exception
    return made[0], made[1]


def test_a_set_without_images_is_the_same_but_for_them(sets: tuple[Path, Path], run: Run) -> None:
    assert run("verify", sets[0])[0] == 0
    assert run("show", sets[0], "MoveCube/test/0", "k0")[0] == 0
    for name in load_buffer_set(sets[0]).episode_ids:
        one, other = (load_buffer(str(name), "k1", buffer_set=root) for root in sets)
        assert (one.cameras, other.cameras) == ((), ("front",))
        assert np.array_equal(one.states, other.states)
        assert one.evidence is not None and len(one) == len(other)
        assert [part.to_dict() for part in one.evidence] == [
            part.to_dict() for part in other.evidence or ()
        ]
        assert sum(len(chunk.states) for chunk in one.stream()) == len(one)
    for memory in ("framesamp", "window"):
        cells = [ceiling(load_buffer_set(root), CeilingConfig(memory=memory)) for root in sets]
        assert cells[0] == cells[1]


def test_lerobot_opens_it(sets: tuple[Path, Path]) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("bare", root=sets[0] / "demonstrations")
    assert dataset.meta.camera_keys == []
    assert dataset[0]["observation.state"].shape == (8,)


@pytest.mark.parametrize(
    "command",
    [
        ("index", "--encoder", "thumbnail"),
        ("evaluate", "--policy", "replay", "--out", "out"),
        ("show", "MoveCube/test/0", "k0", "--out", "out/strip.png"),
    ],
)
def test_what_needs_images_says_so(
    sets: tuple[Path, Path], tmp_path: Path, run: Run, command: tuple[str, ...]
) -> None:
    name, *options = (str(tmp_path / one) if one.startswith("out") else one for one in command)
    code, _, errors = run(name, sets[0], *options)
    assert code != 0 and "Traceback" not in errors
    assert "stored without images" in errors and "Build a buffer set with `cameras`" in errors
    assert not (tmp_path / "out").exists()


def test_a_card_needs_no_images(sets: tuple[Path, Path], run: Run) -> None:
    """It has no film strip, and its example reads no frames."""
    code, card, errors = run("card", sets[0])
    assert code == 0, errors
    assert "![" not in card and "buffer.states" in card
    assert buffer_set_facts(load_buffer_set(sets[0])).pictures() == {}
