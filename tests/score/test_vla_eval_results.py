"""Results of vla-eval as rows: what fails is an error, and what is no result is refused."""

import json
from pathlib import Path
from typing import Any

import pytest
from support.messages import raises
from support.scoring import OWN, REVISION

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.schema.codec import to_dict

KEY = {"system": OWN, "simulator": "tabletop", "buffer_set": "made", "revision": REVISION}
KEY |= {"family": "MoveCube", "condition": "k0", "split": "test", "shift": "none"}
KEY |= {"training_seed": None, "model_seed": 0, "protocol_version": 1} | to_dict(SystemFacts())
TASK = KEY | {"name": "MoveCube/k0", "episode": "0,3-5"}
ROW = KEY | {"episode": 0, "status": "success", "success": True}


def write(path: Path, *episodes: Any) -> Path:
    path.write_text(json.dumps({"tasks": [{"episodes": episodes}]}))
    return path


def failed(index: Any, **changed: Any) -> dict[str, Any]:
    """An episode as vla-eval records one that raised."""
    reason = {"failure_reason": "env_step", "metrics": {"success": False}, "episode_idx": index}
    return TASK | reason | changed


def test_an_episode_that_failed_is_an_error_of_its_own_number(tmp_path: Path) -> None:
    rows = read_rows([write(tmp_path / "a.json", TASK | {"metrics": ROW}, failed(2))])
    assert [(row.episode, row.status, row.success) for row in rows] == [
        (0, "success", True),
        (4, "error", None),
    ]


def test_episodes_beyond_the_last_are_bad_rows(tmp_path: Path) -> None:
    path = write(tmp_path / "a.json", TASK | {"metrics": ROW}, failed(4))
    with raises(FormatError):
        read_rows([path])
    assert [row.episode for row in read_rows([path], lenient=True)] == [0]


@pytest.mark.parametrize(
    "episode",
    [
        *("text", None, {}, {"metrics": None}, {"metrics": [ROW]}),
        {"metrics": {"success": True}},  # of another benchmark
        {"metrics": ROW | {"status": ["success"]}},
        *(failed("0"), failed(None), failed(0, episode=0), failed(0, episode=None)),
        {"metrics": {"success": False}, "failure_reason": "env_step", "episode_idx": 0},
    ],
)
def test_other_files_are_no_results(tmp_path: Path, episode: Any) -> None:
    with raises(FormatError):
        read_rows([write(tmp_path / "a.json", episode)])
