"""The whole way on the embedded simulator: build a split of it, evaluate, benchmark."""

import subprocess
import sys
from pathlib import Path

import pytest
from run_calls import untimed
from test_benchmarks import printed

from robomme_interference_data.errors import NoRendererError
from robomme_interference_data.evaluate import run_evaluation

pytest.importorskip("mani_skill", reason="needs the extra sim")
pytestmark = pytest.mark.slow

COMMAND = Path(sys.executable).parent / "robomme-interference"


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two query episodes, two distractor units."""
    from robomme_interference_data.simulators.registry import make_simulator

    try:
        make_simulator("tabletop").close()
    except NoRendererError as error:
        pytest.skip(str(error))
    out = tmp_path_factory.mktemp("tabletop")
    played = "--source tabletop --episodes 0 --cameras front --workers 2"
    demonstrations, distractors = out / "demonstrations", out / "distractors"
    for words in (
        f"demonstrations {played} --split test --families MoveCube,RouteStick "
        f"--out {demonstrations}",
        f"distractors {played} --families PatternLock,VideoUnmask --out {distractors}",
        f"manifests --demonstrations {demonstrations} --distractors {distractors} --k 0 --k 1 "
        f"--out {out}/manifests",
    ):
        done = subprocess.run(
            [COMMAND, "build", *words.split()],
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    return out


def test_one_worker_and_four_write_the_same_rows(split: Path, tmp_path: Path) -> None:
    runs = [
        run_evaluation(
            "replay",
            split,
            tmp_path / str(workers),
            conditions=["no-history", "k0", "k1"],
            episodes="0",
            memory="full",
            check_lesson=True,  # the split was built from the same simulator: the same bits
            workers=workers,
        )
        for workers in (1, 4)
    ]
    one, four = (untimed(run.rows) for run in runs)
    assert one == four
    status = {(row["family"], row["condition"]): row["status"] for row in one}
    for family in ("MoveCube", "RouteStick"):  # all that they ask for is in the arm's motion
        assert [status[family, k] for k in ("k0", "k1")] == ["success", "success"]
        assert status[family, "no-history"] != "success"


def test_the_benchmark_prints_the_overhead_and_what_a_second_worker_brings(split: Path) -> None:
    options = ("--split", split, "--episodes", "MoveCube/test/0", "--rounds", "1")
    overhead, workers = printed("evaluate", *options, "--rollouts", "4")
    ((episode, steps, seconds, *ratios, frames),) = overhead
    assert episode == "MoveCube/test/0"
    assert int(steps) > 50 and int(frames) > 50 and float(seconds) > 0
    assert len(ratios) == 3 and all(float(ratio) > 0 for ratio in ratios)
    assert [row[0] for row in workers] == ["1", "2"]
    assert workers[0][2] == "1.00" and float(workers[1][2]) > 0
