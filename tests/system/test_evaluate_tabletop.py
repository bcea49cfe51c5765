"""Evaluations on the embedded simulator: replay over the lesson, guesses without drawing."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.package import imported_modules
from support.runs import untimed

from robomme_interference_data.errors import LeakError, NoRendererError
from robomme_interference_data.evaluate import RunConfig, run_evaluation
from robomme_interference_data.evaluate.probe.result import Probe
from robomme_interference_data.runtime.executor import Serial

pytest.importorskip("mani_skill", reason="needs the extra sim")
pytestmark = pytest.mark.slow

COMMAND = Path(sys.executable).parent / "robomme-interference"
EXAMPLE = Path(__file__).parents[2] / "examples" / "memory_policy"


@pytest.fixture(scope="module")
def buffer_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two query episodes, a distractor unit."""
    from robomme_interference_data.simulators.registry import make_simulator

    try:
        make_simulator("tabletop").close()
    except NoRendererError as error:
        pytest.skip(str(error))
    out = tmp_path_factory.mktemp("tabletop")
    played = "--source tabletop --episodes 0 --cameras front --workers 2"
    for words in (
        f"build {out} --only demonstrations {played} --split test --families MoveCube,RouteStick",
        f"build {out} --only executions {played} --split test --families RouteStick",
        f"build {out} --only distractors {played} --families PatternLock",
        f"build {out} --only manifests --conditions no-history,k0,k1",
        f"index {out}",
    ):
        command = [COMMAND, *words.split()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=400, check=False)
        assert done.returncode == 0, done.stderr
    return out


def test_replay_retraces_the_lesson_with_one_worker_as_with_two(
    buffer_set: Path, tmp_path: Path
) -> None:
    # The buffer set was built from the same simulator: the same bits. Retracing the arm's motion
    # solves MoveCube and RouteStick.
    runs = [
        run_evaluation(
            RunConfig(
                *("replay", buffer_set, tmp_path / str(workers)),
                conditions=("k0", "k1"),
                workers=workers,
                check_lesson=True,
            )
        )
        for workers in (1, 2)
    ]
    one, two = (untimed(run.rows) for run in runs)
    assert one == two
    assert [row["status"] for row in one] == ["success"] * 4


_RETRIEVE = """
from pathlib import Path

from robomme_interference_data.evaluate import RunConfig, run_evaluation
from robomme_interference_data.runtime.executor import Serial

config = RunConfig(
    policy="replay:framesamp:32",
    buffer_set={buffer_set!r},
    out=Path("run"),
    conditions=("k1",),
    families=("MoveCube",),
    retrieval="thumbnail",
)
[row] = run_evaluation(config, executor=Serial()).rows
assert row.retrieval_start is not None
"""


def test_a_rollout_with_retrieval_imports_what_it_uses(buffer_set: Path, tmp_path: Path) -> None:
    modules = imported_modules(_RETRIEVE.format(buffer_set=str(buffer_set)), tmp_path)
    assert {"retrieval.selector", "simulators.tabletop.families.move_cube"} <= {*modules}
    unneeded = ("build_dataset", "cards", "cli", "evaluate.language", "evaluate.score", "training")
    assert [name for name in modules if name.startswith(unneeded)] == []
    assert not {"simulators.tabletop.families.insert_peg", "retrieval.encoders.siglip"} & {*modules}


def test_the_oracle_always_succeeds_and_nothing_is_drawn(buffer_set: Path, tmp_path: Path) -> None:
    config = RunConfig("oracle", buffer_set, tmp_path / "run", conditions=("no-history",))
    assert [row.status for row in run_evaluation(config).rows] == ["success"] * 2


def test_follow_subgoals_matches_oracle_with_subgoals_and_guess_without(
    buffer_set: Path, tmp_path: Path
) -> None:
    def ended(policy: str, subgoals: str | None = None) -> dict[tuple[str, str], tuple[str, int]]:
        out = tmp_path / f"{policy}-{subgoals}"
        rows = run_evaluation(RunConfig(policy, buffer_set, out, subgoals=subgoals, workers=2)).rows
        return {(row.family, row.condition): (row.status, row.steps) for row in rows}

    obeyed, guessed = ended("follow-subgoals", "oracle"), ended("guess")
    assert {condition for _, condition in obeyed} == {"no-history", "k0", "k1"}
    assert {status for status, _ in obeyed.values()} == {"success"}
    assert ended("follow-subgoals") == guessed  # the floor, to the very step
    assert {status for status, _ in guessed.values()} != {"success"}


def test_a_policy_that_keeps_its_path_is_an_error_before_the_run(
    buffer_set: Path, tmp_path: Path
) -> None:
    """The documentation's example with a reset that clears nothing; as it is, it passes."""

    def probe(policy: str) -> Probe | None:
        text, out = f"python:support.leaky:{policy}", tmp_path / "run"
        config = RunConfig(text, buffer_set, out, conditions=("k0", "k1"), families=("MoveCube",))
        return run_evaluation(config, executor=Serial()).probe

    with pytest.raises(LeakError) as raised:
        probe("Leaky")
    assert (raised.value.component, raised.value.step) == ("policy", 0)
    found = probe("Retrace")
    assert found is not None and found.verdict == "independent"


def test_the_example_policy_learns_to_act(
    buffer_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is trained on one execution, and carries it out from the lesson."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    run = tmp_path / "run"
    options = (
        "--split test --task act --conditions k0 --noise 0.005 --learning-rate 2e-3 --device cpu"
    )
    small = "--steps 400 --batch 16 --image-size 16"
    program = [sys.executable, EXAMPLE / "train.py", buffer_set, "--out", run]
    program += [*options.split(), *small.split()]
    done = subprocess.run(program, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stderr
    config = RunConfig(
        *("python:memory_policy:MemoryPolicy", buffer_set, tmp_path / "results"),
        policy_options=(f"checkpoint={run}", "device=cpu"),
        system="acts",
        conditions=("k0",),
        families=("RouteStick",),
    )
    assert [row.status for row in run_evaluation(config).rows] == ["success"]
