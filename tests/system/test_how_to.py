"""Every how-to runs: each page is a script, from its first line to its last, in one folder.

A page's folder is prepared with the data that the page starts from. Nothing is left out except what
`NOT_RUN` lists with the reason. Servers, models, the Hub and rollouts have stand-ins.
"""

import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import worlds
from support.buffer_sets import GOLDEN, build, copy_buffer_set, plan_again
from support.chat_server import ChatServer
from support.hub import push_buffer_set
from support.page_scripts import Step, folder_on_path, steps_of, words_of
from support.policy_server import PolicyServer
from support.public_sets import HSR, PublicSet, vector, video, write_public_set
from support.recordings import make_episode, rows_of, write_table, write_video
from support.serve_policy import command as serve_command
from support.tabletop import copy_tabletop

from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.evaluate.run import evaluation as run_module
from robomme_interference_data.runtime.executor import Serial

ROOT = Path(__file__).parents[2]
HOW_TO = ROOT / "docs" / "how-to"
PAGES = sorted(path.name for path in HOW_TO.glob("*.md"))

NOT_RUN = {
    (
        "connect-a-policy.md",
        "evaluate my-buffers --policy lerobot",
    ): "a checkpoint; test_evaluate_lerobot.py makes and runs one",
    ("connect-a-policy.md", "build my-training"): "hours of simulation",
    ("many-machines.md", "evaluate namespace/name --executor ray"): "a cluster; test_cluster.py",
    ("many-machines.md", "index my-buffers --encoder siglip"): "a cluster and 3.5 GB of weights",
    ("many-machines.md", "build shards/"): "hours of simulation; test_shards.py",
    ("many-machines.md", "merge shards/1"): "the same",
    (
        "official-simulator.md",
        "simulate MoveCube/test/0 --simulator robomme",
    ): "RoboMME; test_robomme_whole.py goes this way with a stand-in",
    (
        "official-simulator.md",
        "build my-buffers --only demonstrations",
    ): "RoboMME; test_robomme_whole.py goes this way with a stand-in",
    (
        "official-simulator.md",
        "build my-buffers --only distractors",
    ): "RoboMME's recordings; test_source_h5.py",
    (
        "official-simulator.md",
        "evaluate my-buffers --simulator robomme",
    ): "RoboMME; test_robomme_whole.py goes this way with a stand-in",
    (
        "official-simulator.md",
        "evaluate my-buffers --policy websocket",
    ): "released checkpoints and RoboMME; test_systems.py",
    (
        "official-simulator.md",
        "evaluate my-buffers --policy 'websocket",
    ): "released checkpoints and RoboMME; test_servers.py",
    ("official-simulator.md", "index my-buffers --encoder siglip"): "3.5 GB of weights",
    ("train-a-policy.md", "build my-"): "hours of simulation",
    ("train-a-policy.md", "from robomme_interference_data.training"): "test_history_dataset.py",
    ("train-a-policy.md", "score k0.csv"): "hours of training; test_memory_policy.py",
    ("train-a-policy.md", "evaluate my-buffers --policy answers"): "hours of training",
    ("train-a-policy.md", "score results/acted-k0"): "hours of training",
    ("train-a-policy.md", "build demo/buffers --source"): "minutes of simulation",
    ("train-a-policy.md", "train demo/buffers"): "test_lerobot_train.py",
    ("train-a-policy.md", "evaluate demo/buffers"): "the same; test_lerobot.py",
    ("train-a-policy.md", "score results/history-act"): "the same",
    ("train-a-policy.md", "evaluate my-buffers --policy python"): "hours of training",
    ("connect-a-policy.md", "evaluate my-buffers --policy vla-eval"): "a server; test_vla_eval.py",
    ("connect-a-policy.md", "score results/*_aggregate.json"): "vla-eval's results; its own test",
    ("your-own-policy.md", "from pathlib import Path"): "starts processes; test_run.py",
    ("publish.md", "from datasets import load_dataset"): "reads the Hub; test_cards.py",
    ("another-benchmark.md", "from robomme_interference_data.simulators"): "an outline, not code",
    ("another-benchmark.md", "build reach-buffers"): "another interpreter; test_remote.py makes it",
    ("another-benchmark.md", "evaluate reach-buffers"): "the same",
}
"""What pages show and this test does not run: page, beginning of the step, and why. It must shrink:
an entry that fits no step is an error."""

OTHER_PROGRAMS = {
    *("pip", "export", "hf", "uv", "swift", "vllm", "lerobot-train", "vla-eval", "cd"),
    *("python", "IMAGE_MAX_TOKEN_NUM=256", "git", "make", "scripts/install_robomme.sh", "exec"),
    "scripts/official_set.sh",
}
"""Programs that are not this package's; those that train and answer have tests of their own."""


def golden(folder: Path) -> None:
    copy_buffer_set(folder / "my-buffers")


def asked(folder: Path) -> None:
    copy_tabletop(folder / "my-buffers")


def trained(folder: Path) -> None:
    for name in ("my-buffers", "my-training"):
        copy_tabletop(folder / name)


def executed(folder: Path) -> None:
    """A buffer set with executions."""
    golden(folder)
    families = ("VideoRepick", "MoveCube", "PatternLock")
    source = SampleSource(size=32)
    build(folder / "my-buffers", "executions", source, families=families, split="test")
    plan_again(folder / "my-buffers")


def scored(folder: Path) -> None:
    """A buffer set, and rows under the names and in the layouts of the paper's authors."""
    golden(folder)
    results = ROOT / "docs" / "results"
    rows = results / "retrieval-replay-framesamp-robomme_rollouts.csv"
    shutil.copy(rows, folder / "retrieval_rollouts.csv")
    head, *lines = (results / "replay-framesamp-robomme_rollouts.csv").read_text().splitlines()
    named = [f"system,{head}", *(f"perceptual-framesamp-modul,{line}" for line in lines)]
    (folder / "canonical_rollouts.csv").write_text("\n".join(named) + "\n")


def boards(folder: Path) -> None:
    """A buffer set where the demo has one, and the page's file of a leaderboard on it."""
    copy_buffer_set(folder / "demo" / "buffers")
    text = (HOW_TO / "leaderboard.md").read_text(encoding="utf-8")
    [file] = re.findall(r"^```yaml\n(.*?)^```", text, flags=re.S | re.M)
    played = file.replace("simulator: tabletop", "simulator: support.worlds:World")
    (folder / "demo" / "results.yaml").write_text(played, encoding="utf-8")


def nothing(folder: Path) -> None:
    """The page makes what it needs."""


def recorded(folder: Path) -> None:
    """Recordings of another robot with the cameras and sizes of the golden buffer set."""
    golden(folder)
    rows = []
    for number, family in enumerate(("Drawer", "Cup")):
        name, episode = f"{family}/train/0", make_episode(number, 249, size=(32, 32), actions=False)
        for camera, images in episode.images.items():
            write_video(folder / f"my-recordings/videos/{camera}/{name}.mkv", images)
        rows += rows_of(name, episode)
    write_table(folder / "my-recordings", rows)


def robots(folder: Path) -> None:
    """Recordings of two robots, the queries of the first one marked."""
    mine = PublicSet(
        version="v2.1",
        fps=10,
        robot="mine",
        features={
            "observation.images.top": video(48, 96),
            "observation.state": vector(8),
            "action": vector(8),
        },
        columns={},
        state=8,
        cameras=("top",),
    )
    tasks = ("open the drawer", "stack the cups", "open the drawer")
    write_public_set(folder / "my_robot", mine, (80, 20, 70), tasks)
    small = {"observation.image.head": video(48, 64), "observation.image.hand": video(48, 64)}
    theirs = replace(HSR, version="v2.0", features=HSR.features | small)
    write_public_set(folder / "their_robot", theirs, (600,), ("Pick up the red cup.",))
    lines = ("0,OpenDrawer,test,60,10,75", "1,StackCups,train,0,,", "2,OpenDrawer,test,50,,")
    header = "episode_index,family,split,exec_start_idx,start,stop"
    (folder / "queries.csv").write_text("\n".join((header, *lines)))


PREPARED: dict[str, Callable[[Path], None]] = {
    "another-benchmark.md": nothing,
    "compare-systems.md": scored,
    "days.md": nothing,
    "leaderboard.md": boards,
    "publish.md": recorded,
    "real-robots.md": robots,
    "retrieval.md": nothing,
    "train-a-policy.md": trained,
    "vision-language-model.md": asked,
    "your-own-policy.md": executed,
    "your-own-recordings.md": nothing,
}
"""The data that a page starts from, where that is not any buffer set `my-buffers`."""

BEFORE = {
    "many-machines.md": ("evaluate my-buffers --policy replay --out runs/shard-1 --shard 1/8",),
    "publish.md": (
        "evaluate my-buffers --policy replay --out my-run --episodes 0",
        "evaluate my-buffers --policy replay:window --out theirs --episodes 0",
        "evaluate my-buffers --policy replay --out runs/mine --episodes 0",
    ),
}
"""Runs that a page starts from."""

REAL = ("another-benchmark.md",)
"""Pages whose rollouts run in the simulator that they name; others in `support.worlds`."""


@pytest.fixture
def stand_ins(hub: Any, login: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Servers, by the text on pages that they replace."""
    login("my-name")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests"))
    monkeypatch.setattr(run_module, "make_executor", lambda config: Serial())
    server = serve_command("--metadata", '{"name": "stand-in"}')
    with ExitStack() as stack:
        chat = stack.enter_context(ChatServer(lambda seen: "A"))
        servers = [stack.enter_context(PolicyServer().running()) for _ in range(2)]
        yield {
            "openai:http://localhost:8000/v1#Qwen/Qwen3-VL-4B-Instruct": f"openai:{chat.url}#tiny",
            # Without `device`: of your-own-policy.md, which saves this policy.
            "lerobot:me/act@v1 --system act-v1 --offline": (
                "python:retrace:make --system act-v1 --offline"
            ),
            "localhost:8013": f"localhost:{servers[0].port}",
            "localhost:8014": f"localhost:{servers[1].port}",
            "'websocket:python serve.py --port {port}'": shlex.quote(f"websocket:{server}"),
        }


@pytest.mark.slow
@pytest.mark.timeout(1200)  # of retrieval.md and days.md: they build from the simulator
@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs_from_top_to_bottom(
    page: str,
    tmp_path: Path,
    run: Any,
    hub: Any,
    stand_ins: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "page"
    folder.mkdir()
    monkeypatch.chdir(folder)
    PREPARED.get(page, golden)(folder)
    built = {"days.md": "my-days", "leaderboard.md": "demo/buffers"}.get(page, "my-buffers")
    monkeypatch.setenv(worlds.BUFFER_SET, str(folder / built))
    push_buffer_set(hub, GOLDEN, tmp_path / "work", "namespace/name")
    names: dict[str, Any] = {}
    steps = [*steps_of((HOW_TO / page).read_text(encoding="utf-8"))]
    steps[:0] = [Step("command", text) for text in BEFORE.get(page, ())]
    for step in steps:
        if any(step.text.startswith(start) for name, start in NOT_RUN if name == page):
            continue
        if step.kind == "other":
            assert step.text.split()[0] in OTHER_PROGRAMS, step.text
        elif step.kind == "file":
            Path(step.name).write_text(step.text, encoding="utf-8")
        elif step.kind == "python":
            exec(compile(step.text, page, "exec"), names)
        else:
            _run_command(page, step, run, stand_ins, monkeypatch)
    for module in ("retrace", "retrace_batch", "lamp", "remember"):
        sys.modules.pop(module, None)


def _run_command(
    page: str, step: Step, run: Any, stand_ins: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = step.text
    for shown, meant in stand_ins.items():
        text = text.replace(shown, meant)
    words = words_of(Step("command", text))
    if words[0] == "evaluate" and page not in REAL and "--offline" not in words:
        words += ["--simulator", "support.worlds:World"]
    path = folder_on_path(step, ROOT)
    if path is not None:
        monkeypatch.syspath_prepend(path)  # for this process, and for those that it starts
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "tests"), str(path)]))
    code, out, err = run(*words)
    assert code == 0, f"{page}: {step.text}\n{out}\n{err}"


def test_what_is_not_run_is_on_its_page() -> None:
    for page, start in NOT_RUN:
        texts = [step.text for step in steps_of((HOW_TO / page).read_text(encoding="utf-8"))]
        assert any(text.startswith(start) for text in texts), f"{page}: {start}"
