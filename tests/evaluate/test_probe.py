"""The leak probe: its rules, and runs that it stops, measures or lets begin."""

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lazy import lazy
from support.messages import raises
from support.policy_server import Memory, PolicyServer, RetraceMemory
from support.runs import header, run
from support.serve_policy import command

from robomme_interference_data.errors import FormatError, LeakError
from robomme_interference_data.evaluate.language import subgoal_settings
from robomme_interference_data.evaluate.language.subgoal_writers import OracleWriter
from robomme_interference_data.evaluate.probe.judgment import ProbeVerdict, first_difference, judge
from robomme_interference_data.evaluate.probe.noise import LEAK_P, flips, noise_p
from robomme_interference_data.evaluate.probe.plays import (
    ENOUGH_ROLLOUTS,
    PlannedPlay,
    rounds,
    sequence,
)
from robomme_interference_data.evaluate.probe.result import Probe, joined_probe, probe_text
from robomme_interference_data.evaluate.probe.trace import Component, Event, Play
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.ids import EpisodeId

servers = lazy("support.vla_eval_servers")
LEAKY = "python:support.leaky:"
CONDITIONS = ("no-history", "k0", "k7")

# --- rules ---------------------------------------------------------------------------------------


@st.composite
def grids(draw: st.DrawFn) -> list[WorkItem]:
    families = draw(st.sampled_from([("MoveCube",), ("MoveCube", "VideoRepick", "PatternLock")]))
    names = draw(st.sampled_from([("k0",), CONDITIONS]))
    numbers = range(draw(st.integers(1, 40)))
    episodes = [EpisodeId(family, "test", number) for family in families for number in numbers]
    return [WorkItem(name, episode) for episode in episodes for name in names]


def still(item: WorkItem) -> bool:
    """The robot moves in no lesson."""
    return False


@given(grids(), st.integers(1, 3), st.randoms(use_true_random=False))
def test_a_sequence_is_small_and_repeats_a_rollout_after_another(
    items: list[WorkItem], clients: int, random: Any
) -> None:
    planned = sequence(items, still, clients=clients)
    shuffled = random.sample(items, len(items))
    assert sequence(shuffled, still, clients=clients) == planned
    assert len(planned) <= max(4, 0.05 * len(items))
    assert {play.item for play in planned} <= {*items}
    assert planned[0] == planned[2]
    if len({item.condition for item in items}) > 1:
        assert (planned[0].item.condition, planned[1].item.condition) == ("no-history", "k7")
    if len({item.episode.family for item in items}) > 1:
        assert planned[0].item.episode.family != planned[1].item.episode.family
    assert any(play.beside is not None for play in planned) == (clients > 1)
    assert any(play.whole for play in planned) == (len(items) >= ENOUGH_ROLLOUTS)


@given(grids())
def test_a_rollout_comes_after_one_whose_robot_moves(items: list[WorkItem]) -> None:
    moving = items[-1].episode
    planned = sequence(items, lambda item: item.episode == moving, clients=2)
    assert {play.item for play in planned if play.beside or play.whole} == {planned[1].item}
    assert planned[1].item.episode == moving


@given(grids())
def test_rounds_have_pairs_after_the_same_rollout(items: list[WorkItem]) -> None:
    planned = rounds(items)
    assert len(planned) <= max(16, 0.05 * len(items))
    pairs = Counter(pairwise(planned))
    count = len({*planned})
    assert len(planned) == 4 * count
    assert count < 2 or sum(number >= 2 for number in pairs.values()) >= 2 * count - 2


System = Callable[[PlannedPlay, tuple[PlannedPlay, ...], tuple[PlannedPlay, ...]], float]


def played(planned: tuple[PlannedPlay, ...], times: int, system: System) -> list[list[Play]]:
    """What a system does that knows a rollout, its client's past, and the whole past."""
    repeats, ever = list[list[Play]](), tuple[PlannedPlay, ...]()
    for _ in range(times):
        plays, past = list[Play](), tuple[PlannedPlay, ...]()
        for play in planned:
            value = system(play, past, ever)
            events = (
                Event(Component.SIMULATOR, 0, b"the same"),
                Event(Component.POLICY, 0, repr(value).encode()),
            )
            after = ever[-1].label if ever else None
            labels = tuple(each.label for each in past)
            status = "success" if value > 0 else "fail"
            plays.append(Play(play, labels, after, events, (value,), status))
            past, ever = (*past, play), (*ever, play)
        repeats.append(plays)
    return repeats


def number(*what: object) -> float:
    """A number between -1 and 1 that depends on everything given."""
    return float(np.random.default_rng([*repr(what).encode()]).uniform(-1, 1))


@given(grids(), st.sampled_from(["nothing", "client", "process", "all"]), st.integers(1, 2))
def test_a_judgment_tells_what_a_system_remembers(
    items: list[WorkItem], remembers: str, clients: int
) -> None:
    planned = sequence(items, still, clients=clients)

    def system(play: PlannedPlay, past: Any, ever: Any) -> float:
        known = {"nothing": (), "client": past, "process": ever[-1:], "all": ever}[remembers]
        return number(play.item, known)

    plays = [play for repeat in played(planned, 3, system) for play in repeat]
    verdict, difference = judge(plays)
    expected = {
        "nothing": ProbeVerdict.INDEPENDENT,
        "client": ProbeVerdict.LEAK,
        "process": ProbeVerdict.LEAK,
        # What outlives a client for longer than a rollout cannot be told from noise.
        "all": ProbeVerdict.NOISE,
    }
    if remembers != "process" or len(items) > 1:
        assert verdict is expected[remembers]
    assert (difference is None) == (verdict is ProbeVerdict.INDEPENDENT)
    assert difference is None or difference.event.component is Component.POLICY


def test_the_first_difference_ends_with_the_shorter_play() -> None:
    events = [Event(Component.POLICY, step, bytes([step])) for step in range(4)]
    assert first_difference(events, events[:2]) is None
    assert first_difference(events, [*events[:2], events[3]]) == events[3]


def test_noise_is_rarely_taken_for_a_leak_and_a_large_leak_is_seen() -> None:
    episodes = [EpisodeId("MoveCube", "test", index) for index in range(8)]
    items = [WorkItem(name, episode) for episode in episodes for name in CONDITIONS]
    planned, more = sequence(items, still, clients=2), rounds(items)
    draws = np.random.default_rng(0)

    def noise(play: PlannedPlay, past: Any, ever: Any) -> float:
        return float(draws.normal())

    def leak(play: PlannedPlay, past: Any, ever: Any) -> float:
        return float(bool(past)) + float(draws.normal(0, 0.01))

    def growth(play: PlannedPlay, past: Any, ever: Any) -> float:
        return len(ever) + float(draws.normal(0, 0.01))

    def alarm(system: System) -> bool:
        (plays,) = played(more, 1, system)
        return noise_p(played(planned, 7, system), plays) < LEAK_P

    assert sum(alarm(noise) for _ in range(100)) <= 3  # at most one is expected
    assert all(alarm(leak) for _ in range(5))
    assert all(alarm(growth) for _ in range(5))


def test_flips_are_counted_after_the_same_rollout_only() -> None:
    items = [WorkItem("k0", EpisodeId("MoveCube", "test", index)) for index in range(4)]
    values = iter([1, 1, 1, 1, -1, -1, 1, 1, *[1] * 8])
    (plays,) = played(rounds(items), 1, lambda *_: float(next(values)))
    # The second round flips two rollouts; before the first one came nothing, and then another.
    assert flips(plays) == (6, 1)


def test_the_probe_of_merged_shards_is_the_weakest_and_names_those_without() -> None:
    good, noisy = Probe("independent", (), 3, 1), Probe("nondeterministic", (), 3, 1, p_value=0.4)
    assert joined_probe([("one", good), ("two", noisy)]) == noisy
    assert joined_probe([("one", None)]) is None
    some = joined_probe([("one", good), ("two", None)])
    assert some is not None and (some.verdict, some.unprobed) == ("independent", ("two",))
    assert some.done and good.all_independent and not some.all_independent
    assert probe_text(some).endswith("after any predecessor; not probed: two")
    again = joined_probe([("merged", some), ("three", None), ("four", good)])
    assert again is not None and again.unprobed == ("three", "two")


@pytest.mark.parametrize("values", [{"verdict": "fine"}, {"verdict": "nondeterministic"}])
def test_what_is_no_verdict(values: dict[str, Any]) -> None:
    with raises(FormatError):
        Probe(rollouts=(), plays=3, clients=1, **values)


# --- runs ----------------------------------------------------------------------------------------


class Notes:
    """Progress that keeps what is said of the probe."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def start(self, items: Any, done: Any) -> None: ...

    def row(self, row: Any, node: Any) -> None: ...


@pytest.fixture(autouse=True)
def _world(world: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))  # of servers


def probed(out: Path, policy: str, **changes: Any) -> Any:
    """A run with the probe; what its header has of it."""
    run(out, policy=policy, no_probe=False, **{"conditions": CONDITIONS, **changes})
    return header(out)["probe"]


@pytest.mark.parametrize(
    ("policy", "changes", "component"),
    [
        (f"{LEAKY}Leaky", {}, "policy"),
        (f"{LEAKY}NoisyLeaky", {}, "policy"),
        ("noop", {"simulator": "support.leaky:LeakyWorld"}, "simulator"),
        ("noop", {"simulator": "support.leaky:BrokenWorld"}, "simulator"),
        (f"websocket:{command('--leaks')}", {}, "policy"),
    ],
    ids=["own", "noisy", "simulator", "broken", "websocket"],
)
def test_a_leak_is_an_error_before_the_run(
    tmp_path: Path, policy: str, changes: dict[str, Any], component: str
) -> None:
    out = tmp_path / "run"
    with raises(LeakError) as raised:
        probed(out, policy, **changes)
    assert (raised.value.component, raised.value.step) == (component, 0)
    # Nothing of it is left: another policy may run there.
    assert probed(out, f"{LEAKY}Retrace")["verdict"] == "independent"


def test_a_leaky_writer_of_subgoals_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Leaky(OracleWriter):
        def start(self, *given: Any) -> None:
            before = getattr(self, "turns", [])
            super().start(*given)
            self.turns = before

        def next(self, observation: Any, step: int) -> Any:
            subgoal = super().next(observation, step)
            return type(subgoal)(f"{subgoal.text} {len(self.turns)}", subgoal.points)

    monkeypatch.setattr(subgoal_settings, "make_writer", lambda config: Leaky())
    with raises(LeakError) as raised:
        probed(tmp_path / "run", f"{LEAKY}Retrace", subgoals="oracle")
    assert (raised.value.component, raised.value.step) == ("subgoal writer", 0)


def test_noise_is_measured_and_stops_nothing(tmp_path: Path) -> None:
    progress = Notes()
    found = probed(tmp_path / "run", f"{LEAKY}Noisy", progress=progress)
    assert (found["verdict"], found["component"], found["pairs"]) == (
        "nondeterministic",
        "policy",
        6,
    )
    assert 0 <= found["flips"] <= 6 and found["p_value"] >= LEAK_P
    assert f"{found['flips']} of 6 repeated rollouts" in progress.notes[-1]


def test_a_run_is_probed_once_and_records_if_it_was_not(tmp_path: Path) -> None:
    out = tmp_path / "run"
    run(out, policy="noop", conditions=("no-history",))
    assert header(out)["probe"] is None
    assert header(out)["invocations"][0]["settings"]["no_probe"] is True
    found = probed(out, "noop", conditions=("no-history", "k0"))
    assert (found["verdict"], found["plays"], found["clients"]) == ("independent", 3, 1)
    assert probed(out, "noop") == found  # of two conditions: it is not probed again
    assert found["rollouts"][1].endswith(" k0")


def test_a_probe_that_breaks_is_repeated_by_the_resumed_run(tmp_path: Path, trouble: Path) -> None:
    out = tmp_path / "run"
    (trouble / "VideoRepick-0").write_text("raise")
    broken = probed(out, "noop")
    assert broken["verdict"] == "broken" and "the world fell apart" in broken["error"]
    (trouble / "VideoRepick-0").unlink()
    assert probed(out, "noop")["verdict"] == "independent"


def test_rows_have_a_digest_of_their_actions_and_a_predecessor(tmp_path: Path) -> None:
    rows = run(tmp_path / "run", policy="replay", conditions=("k0",)).rows
    again = run(tmp_path / "again", policy="replay", conditions=("k0",)).rows
    assert [row.actions_sha256 for row in rows] == [row.actions_sha256 for row in again]
    assert len({row.actions_sha256 for row in rows}) == 2
    assert {row.predecessor for row in rows} == {None, f"{rows[0].episode_id} k0"} or {
        row.predecessor for row in rows
    } == {None, f"{rows[1].episode_id} k0"}


@pytest.fixture
def retracing() -> Iterator[PolicyServer]:
    with PolicyServer(RetraceMemory(clears=True)).running() as server:
        yield server


def test_a_server_at_an_address_is_probed_too(tmp_path: Path, retracing: PolicyServer) -> None:
    found = probed(tmp_path / "run", retracing.url, policy_options=("checkpoint=a",))
    assert found["verdict"] == "independent"
    assert sum(call == {"call": "reset"} for call in retracing.calls) >= 9


class Growing(Memory):
    """Moves a little further with every reset."""

    resets = 0

    def reset(self) -> None:
        super().reset()
        self.resets += 1

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        answer = super().answer(message)
        return answer | {"actions": answer["actions"] + self.resets / 1000}


class Drawing(Memory):
    """Draws from a generator that is seeded when the server is started, and never again."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = np.random.default_rng(0)

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        answer = super().answer(message)
        return answer | {"actions": answer["actions"] + self.generator.normal(0, 0.01)}


def test_a_state_that_grows_in_a_server_is_a_leak_or_shows_when_it_is_started_again(
    tmp_path: Path,
) -> None:
    with PolicyServer(Growing()).running() as server, raises(LeakError) as raised:
        probed(tmp_path / "run", server.url, policy_options=("checkpoint=a",))
    assert (raised.value.component, raised.value.step) == ("policy", 0)
    digests = []
    for out in ("run", "again"):
        with PolicyServer(Drawing()).running() as server:
            found = probed(tmp_path / out, server.url, policy_options=("checkpoint=a",))
        assert (found["verdict"], found["component"]) == ("nondeterministic", "policy")
        digests.append(found["digest"])
    assert digests[0] == digests[1]


@pytest.mark.parametrize("shared", [False, True])
def test_two_clients_of_a_server_with_one_queue_are_a_leak(tmp_path: Path, shared: bool) -> None:
    """LeRobot's `select_action` behind a server of vla-eval: all sessions take from one queue."""
    queues = dict[str, list[Any]]()

    def answer(obs: Any) -> Any:
        queue = queues.setdefault("" if shared else obs["task_description"], [])
        if obs.get("episode_restart"):
            queue.clear()
        if not queue:
            queue.extend(np.append(obs["states"][:7] + step / 100, 1.0) for step in range(4))
        return queue.pop(0)

    server = servers.Noting({"send_state": True}, answer=answer)
    options = {"policy_options": ("checkpoint=a",), "conditions": ("no-history",), "workers": 2}
    with servers.running(server) as port:
        policy = f"vla-eval:ws://127.0.0.1:{port}"
        if shared:
            with pytest.raises(LeakError) as raised:
                probed(tmp_path / "run", policy, **options)
            assert "while another client plays" in raised.value.message
        else:
            assert probed(tmp_path / "run", policy, **options)["clients"] == 2
