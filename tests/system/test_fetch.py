"""Fetch after a kill: downloaded files are kept, and the result is the buffer set on disk."""

import json
import re
import signal
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import constants
from support.buffer_sets import GOLDEN, QUERIES, contents
from support.hub import BUFFER_SET, elsewhere, kill_at, push_buffer_set
from support.hub_http import Request
from support.hub_server import HubServer

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set

Run = Callable[..., tuple[int, str, str]]
FETCH = "from robomme_interference_data.cli.main import main; main()"
SPLIT_AT = f"{BUFFER_SET}@data-1.0.0"
FILE = re.compile(r"/(?:store/)?datasets/([^/]+/[^/]+)/(?:resolve/)?[0-9a-f]{40,64}/(.+)")
AT_ONCE = 8
"""Files that are on their way at the same time."""


def in_cache() -> set[tuple[str, ...]]:
    """Return the files that came whole: repository and path."""
    cache = Path(constants.HF_HUB_CACHE)
    found = (path.relative_to(cache).parts for path in cache.glob("*/snapshots/*/**/*.*"))
    return {
        (repo.removeprefix("datasets--").replace("--", "/"), "/".join(path))
        for repo, _, _, *path in found
    }


def asked_for(requests: Iterable[Request]) -> list[tuple[str, ...]]:
    """Return the files that requests are about: repository and path."""
    matches = (FILE.fullmatch(one.path) for one in requests)
    return [match.groups() for match in matches if match]


@pytest.mark.slow
def test_fetch_after_a_kill(hub: HubServer, run: Run, tmp_path: Path) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    out = tmp_path / "out"
    words = ["fetch", SPLIT_AT, "--to", str(out)]
    kill_at(hub, "GET", r"/store/.*\.mp4", 24, FETCH, *words)
    came = in_cache()
    videos = [path for _, path in came if path.endswith(".mp4")]
    assert 24 - AT_ONCE < len(videos) < 24 + AT_ONCE and not out.exists()
    code, printed, _ = run(*words, "--dry-run", "--json")
    missing = sum(one["missing_files"] for one in json.loads(printed)["repositories"])
    assert code == 0 and missing > 0
    before = len(hub.asked)
    assert run(*words)[0] == 0
    asked = hub.asked[before:]
    downloads = asked_for(one for one in asked if one.method == "GET")
    about = {*asked_for(asked)}
    assert len(about) == missing and not came & about
    # Of those that were under way, some may be whole without having their names.
    assert len(downloads) == len({*downloads}) >= missing - AT_ONCE and {*downloads} <= about
    hub.down = True
    buffer_set, here = load_buffer_set(out), load_buffer_set(GOLDEN)
    for query in QUERIES:
        found, expected = (one.load(query, "k7", verify=True) for one in (buffer_set, here))
        for camera in expected.cameras:
            assert np.array_equal(found.frames(camera), expected.frames(camera))
        assert np.array_equal(found.states, expected.states)
    assert list(verify_buffer_set(buffer_set)) == []


KILLED = """
import os, shutil, signal, sys
from pathlib import Path
from robomme_interference_data.cli.main import main

calls = 0

def killing(call):
    def wrapped(*arguments, **options):
        global calls
        result = call(*arguments, **options)
        calls += 1
        if calls == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    return wrapped

step, number = sys.argv[1], int(sys.argv[2])
if step == "copying":
    shutil.copyfile = killing(shutil.copyfile)
else:
    Path.replace = killing(Path.replace)
del sys.argv[1:3]
main()
"""


@pytest.mark.parametrize(
    ("step", "number"),
    [
        pytest.param("copying", 1, marks=pytest.mark.slow),
        pytest.param("copying", 2, marks=pytest.mark.slow),
        pytest.param("copying", 30, marks=pytest.mark.slow),
        pytest.param("copying", 74, marks=pytest.mark.slow),
        # Each copied file is renamed once in the staging folder, and again where it is moved.
        pytest.param("renaming", 40, marks=pytest.mark.slow),
        pytest.param("renaming", 75, marks=pytest.mark.slow),
        pytest.param("renaming", 76, marks=pytest.mark.slow),
        ("renaming", 100),
        pytest.param("renaming", 149, marks=pytest.mark.slow),
        pytest.param("renaming", 150, marks=pytest.mark.slow),
    ],
)
def test_a_copy_after_a_kill(
    hub: HubServer, run: Run, tmp_path: Path, step: str, number: int
) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    out, expected = tmp_path / "out", tmp_path / "expected"
    assert run("fetch", SPLIT_AT, "--to", str(expected))[0] == 0
    words = ["fetch", SPLIT_AT, "--to", str(out)]
    with elsewhere(hub, KILLED, step, str(number), *words) as process:
        process.wait(120)
    assert process.returncode == -signal.SIGKILL
    assert run("list", str(out))[0] == 1  # the manifests' header is moved last
    assert run(*words)[0] == 0
    assert contents(out) == contents(expected)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "expected", "out", "work"]
    assert list(verify_buffer_set(load_buffer_set(out))) == []
