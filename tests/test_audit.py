"""How often units are used, and what leaks."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from made_splits import edit_manifests, metadata_only, split
from recordings import MemorySource, build, listed, opened, run_here
from typer.testing import CliRunner

from robomme_interference_data import load_split
from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset.audit import Audit, Leak, audit_split
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.cli import app


def audited(root: Path) -> Audit:
    opened_split = load_split(root)
    return audit_split(opened_split.manifests(), opened_split.datasets, opened_split.k_values)


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    shutil.copytree(split(), tmp_path / "split")
    return tmp_path / "split"


def pool_leaks(tmp_path: Path, queries: list, units: list) -> list[Leak]:
    """The leaks of two datasets with these episodes."""
    datasets = {
        "demonstrations": metadata_only(tmp_path / "d", "demonstrations", queries),
        "distractors": metadata_only(tmp_path / "u", "distractors", units),
    }
    return audit_split([], datasets, (0,)).leaks


# --- use ----------------------------------------------------------------------------------------


def test_use_by_hand(tmp_path: Path) -> None:
    # MoveCube's query can only draw Drawer's unit, and Drawer's only MoveCube's.
    queries = [listed("MoveCube/test/0"), listed("MoveCube/test/1"), listed("Drawer/test/0")]
    units = [listed("MoveCube/train/0", seed=1), listed("Drawer/train/5", seed=2)]
    metadata_only(tmp_path / "demonstrations", "demonstrations", queries)
    metadata_only(tmp_path / "distractors", "distractors", units)
    datasets = [opened(tmp_path / name) for name in ("demonstrations", "distractors")]
    for _ in write_manifests(plan_manifests(*datasets, (0, 1)), tmp_path / "manifests"):
        pass
    report = audited(tmp_path)
    assert report.leaks == []
    assert {k: {str(u): n for u, n in uses.items()} for k, uses in report.units.items()} == {
        0: {"MoveCube/train/0": 0, "Drawer/train/5": 0},
        1: {"MoveCube/train/0": 1, "Drawer/train/5": 2},
    }
    assert report.usage(0) == {"min": 0, "mean": 0, "max": 0, "unused": 2}
    assert report.usage(1) == {"min": 1, "mean": 1.5, "max": 2, "unused": 0}
    assert report.family_usage(1) == {
        "Drawer": {"units": 1, "min": 2, "mean": 2, "max": 2},
        "MoveCube": {"units": 1, "min": 1, "mean": 1, "max": 1},
    }
    assert report.positions == {1: Counter({"Drawer": 2, "MoveCube": 1})}
    assert report.as_dict() == {
        "usage": {"0": report.usage(0), "1": report.usage(1)},
        "families": report.family_usage(1),
        "positions": {"1": {"Drawer": 2, "MoveCube": 1}},
        "units": {"MoveCube/train/0": 1, "Drawer/train/5": 2},
        "leaks": [],
    }


def test_use_in_a_clean_split() -> None:
    report = audited(split())
    assert report.leaks == []
    assert set(report.units) == {0, 1, 3}
    for k, uses in report.units.items():
        assert len(uses) == 6
        assert sum(uses.values()) == 3 * k  # three queries
    assert set(report.positions) == {1, 2, 3}
    assert all(counts.total() == 3 for counts in report.positions.values())
    family = report.family_usage(3)
    assert sum(row["units"] * row["mean"] for row in family.values()) == pytest.approx(9)


# --- leaks in buffers ---------------------------------------------------------------------------


def change_unit(**values) -> Callable[[list[dict]], None]:
    """Change the second distractor of the buffer of MoveCube/test/1 at k=3."""
    return lambda rows: rows[5]["sessions"][2].update(values)


@pytest.mark.parametrize(
    "values",
    [
        {"source": "MoveCube/train/0", "family": "MoveCube"},
        {"source": "MoveCube/train/0"},  # the family column hides it
        {"family": "MoveCube"},
    ],
    ids=["both", "only the source", "only the family"],
)
def test_own_family(damaged: Path, values: dict) -> None:
    edit_manifests(damaged, change_unit(**values))
    (leak,) = audited(damaged).leaks
    assert leak.kind == "same family"
    assert leak.where.startswith("MoveCube/test/1 at k=3: ")


def test_repeated_unit(damaged: Path) -> None:
    def change(rows: list[dict]) -> None:
        rows[5]["sessions"][2] = dict(rows[5]["sessions"][1])

    edit_manifests(damaged, change)
    repeated = load_split(damaged).manifest("MoveCube/test/1", 3).sessions[1].source
    where = f"MoveCube/test/1 at k=3: {repeated}, 2 times"
    assert audited(damaged).leaks == [Leak("repeated unit", where)]


def test_a_query_as_distractor(damaged: Path) -> None:
    edit_manifests(damaged, change_unit(source="Drawer/test/0", family="Drawer"))
    expected = Leak("not a train episode", "MoveCube/test/1 at k=3: Drawer/test/0")
    assert audited(damaged).leaks == [expected]


def test_lessons_are_no_leaks(damaged: Path) -> None:
    # A lesson in two parts is still the query's own.
    def change(rows: list[dict]) -> None:
        lesson = rows[0]["sessions"][0]
        rows[0]["sessions"] = [{**lesson, "stop": 2}, {**lesson, "start": 2}]

    edit_manifests(damaged, change)
    assert audited(damaged).leaks == []


# --- leaks in the pool --------------------------------------------------------------------------


def test_a_test_unit_in_the_pool(tmp_path: Path) -> None:
    queries = [listed("MoveCube/test/0")]
    units = [listed("Drawer/train/0", seed=1), listed("Drawer/test/1", seed=2)]
    units.append(listed("Drawer/val/1", seed=3))
    assert pool_leaks(tmp_path, queries, units) == [
        Leak("not a train episode", "unit Drawer/val/1"),
        Leak("not a train episode", "unit Drawer/test/1"),
    ]


@pytest.mark.parametrize(
    ("query", "unit", "leaks"),
    [
        ({"seed": 7}, {"seed": 7}, True),
        ({"seed": 7}, {"seed": 8}, False),
        ({"seed": 7}, {"seed": 7, "simulator": "other"}, False),
        ({"seed": None}, {"seed": None}, False),
    ],
)
def test_the_scene_of_a_query(tmp_path: Path, query: dict, unit: dict, leaks: bool) -> None:
    queries = [listed("MoveCube/test/3", **query)]
    units = [listed("MoveCube/train/1", **unit), listed("Drawer/train/0", seed=7)]
    leak = Leak("same scene", "unit MoveCube/train/1 and query MoveCube/test/3 (seed 7)")
    assert pool_leaks(tmp_path, queries, units) == ([leak] if leaks else [])


def test_identical_frames_under_two_ids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_module, "run_tasks", run_here)

    def same(index: int, frame):
        frame.images["front"][:] = index % 256
        return frame

    queries = MemorySource([listed(f"MoveCube/test/{i}", seed=i) for i in range(2)], alter=same)
    units = [listed(name, seed=9) for name in ("Drawer/train/0", "PatternLock/train/3")]
    build("demonstrations", queries, tmp_path / "demonstrations")
    build("distractors", MemorySource(units, alter=same), tmp_path / "distractors")
    datasets = {name: opened(tmp_path / name) for name in ("demonstrations", "distractors")}
    feature = "observation.images.front"
    # The PatternLock family comes before others by the benchmark's order.
    assert audit_split([], datasets, (0,)).leaks == [
        Leak("identical frames", f"PatternLock/train/3 and Drawer/train/0 ({feature})"),
        Leak("identical frames", f"MoveCube/test/0 and MoveCube/test/1 ({feature})"),
    ]


def test_states_may_be_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_module, "run_tasks", run_here)

    def still(index: int, frame):
        frame.state[:] = 0
        return frame

    units = [listed(f"Drawer/train/{i}") for i in range(2)]
    build("distractors", MemorySource(units, alter=still), tmp_path / "u")
    queries = metadata_only(tmp_path / "d", "demonstrations", [listed("MoveCube/test/0")])
    datasets = {"demonstrations": queries, "distractors": opened(tmp_path / "u")}
    records = list(datasets["distractors"].records())
    assert len({record.feature_sha256["observation.state"] for record in records}) == 1
    assert audit_split([], datasets, (0,)).leaks == []


# --- the command --------------------------------------------------------------------------------


def test_command() -> None:
    done = CliRunner().invoke(app, ["audit", str(split())])
    assert done.exit_code == 0
    assert "Uses of a unit" in done.stdout
    assert "Families at k=3" in done.stdout
    assert done.stderr.strip() == "No leaks."
    done = CliRunner().invoke(app, ["audit", str(split()), "--json"])
    assert done.exit_code == 0
    assert json.loads(done.stdout) == json.loads(json.dumps(audited(split()).as_dict()))


def test_command_fails_on_a_leak(damaged: Path) -> None:
    edit_manifests(damaged, change_unit(source="MoveCube/train/0", family="MoveCube"))
    done = CliRunner().invoke(app, ["audit", str(damaged)])
    assert done.exit_code == 1
    assert "LEAK, same family: MoveCube/test/1 at k=3: MoveCube/train/0\n" in done.stdout
    assert done.stderr.strip() == "1 leaks"
    done = CliRunner().invoke(app, ["audit", str(damaged), "--json"])
    assert done.exit_code == 1
    assert json.loads(done.stdout)["leaks"] == [
        {"kind": "same family", "where": "MoveCube/test/1 at k=3: MoveCube/train/0"}
    ]
