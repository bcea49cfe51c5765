"""What a build plans before it reads: episodes, datasets and settings, and invalid ones."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.made_up import MadeUpSource, record, write_metadata
from support.messages import raises

from robomme_interference_data.build_dataset.config import BuffersConfig, BuildConfig
from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.plan.parts import plan_alone, plan_build
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.errors import (
    BuildError,
    InterferenceError,
    InvalidIdError,
    InvalidOptionError,
    MissingFileError,
    SourceError,
)
from robomme_interference_data.storage.staging import staging_path


def made_up(*names: str) -> MadeUpSource:
    return MadeUpSource(dict.fromkeys(names, (9, None)))


def listed(*sources: Any, **filters: Any) -> list[tuple[int, str]]:
    return [(number, str(one.id)) for number, one in choose_episodes(sources, **filters)]


def test_canonical_order_and_source_numbers() -> None:
    one = made_up("PatternLock/train/2", "MoveCube/train/10", "Aaa/train/0")
    two = made_up("MoveCube/train/9", "MoveCube/test/0", "MoveCube/val/3")
    assert listed(one, two) == [
        (1, "MoveCube/train/9"),
        (0, "MoveCube/train/10"),
        (1, "MoveCube/val/3"),
        (1, "MoveCube/test/0"),
        (0, "PatternLock/train/2"),
        (0, "Aaa/train/0"),
    ]


def test_filters() -> None:
    source = SampleSource("MoveCube,X", size=32)
    assert listed(source, split="test") == [(0, "MoveCube/test/0"), (0, "X/test/0")]
    found = listed(source, families=("X",), numbers=(1, 2))
    assert found == [(0, "X/train/1"), (0, "X/train/2")]
    for filters, error in (
        ({"families": ("Y",)}, InvalidOptionError),
        ({"split": "tset"}, InvalidOptionError),
        ({"numbers": (99,)}, SourceError),
    ):
        with pytest.raises(error):
            listed(source, **filters)
    with raises(SourceError) as caught:
        listed(source, source)
    assert "`" not in str(caught.value.hint)  # a filter would leave out both


def config(tmp_path: Path, *source: str, **changes: Any) -> BuildConfig:
    return BuildConfig(source=source or ("sample",), buffer_set=tmp_path / "out", **changes)


def test_units_are_of_train_episodes(tmp_path: Path) -> None:
    plan = plan_dataset("distractors", config(tmp_path))
    assert {one.id.split for _, one in plan.episodes} == {"train"}
    plans = plan_build(
        config(tmp_path, split="test", families=("MoveCube",)), BuffersConfig()
    ).datasets
    assert [str(one.id) for _, one in plans["demonstrations"].episodes] == ["MoveCube/test/0"]
    assert len(plans["distractors"].episodes) == 27
    few = plan_build(config(tmp_path, episodes="0", unit_episodes="0-1"), BuffersConfig())
    assert len(few.datasets["distractors"].episodes) == 18


def test_views_under_shifts_and_executions_are_of_the_queries(tmp_path: Path) -> None:
    further = ("shifted", "executions")
    asked = config(tmp_path, "tabletop", split="test", episodes="0-1", parts=further)
    planned = plan_build(asked, BuffersConfig(("k1",)))
    plans, change = planned.datasets, planned.buffers
    assert change is not None and planned.manifests and not planned.questions
    assert [*plans] == ["demonstrations", "distractors", *further]
    for name in further:
        assert plans[name].episodes == plans["demonstrations"].episodes
    assert (change.added, change.loses) == (("k1",), False)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["contradictions", "shifted", "executions"])
def test_what_goes_with_demonstrations_has_their_episodes_and_cameras(
    kind: str, tmp_path: Path
) -> None:
    config = BuildConfig(source=("tabletop",), buffer_set=tmp_path)
    assert len(plan_alone(kind, config).episodes) > 1000  # all: there are no demonstrations yet
    episodes = {"MoveCube/train/120", "PatternLock/test/1"}
    records = [record("demonstrations", episode, n) for n, episode in enumerate(sorted(episodes))]
    write_metadata(tmp_path / "demonstrations", "demonstrations", records)
    planned = plan_alone(kind, config)
    asked = {f"{one.id.family}/{one.id.split}/{one.id.index}" for _, one in planned.episodes}
    assert asked == episodes
    assert planned.cameras == ("front",)
    chosen = plan_alone(kind, replace(config, split="test", episodes="0-1", cameras=("wrist",)))
    assert len(chosen.episodes) == 18 and chosen.cameras == ("wrist",)
    units = plan_alone("distractors", config)
    assert len(units.episodes) > 18 and units.cameras == ("front",)


@pytest.mark.parametrize(
    ("changes", "plan", "error"),
    [
        ({"workers": 0}, {}, InvalidOptionError),
        ({"time_limit_s": float("nan")}, {}, InvalidOptionError),
        ({"version": "one"}, {}, InvalidOptionError),
        ({"fps": 0.0}, {}, InvalidOptionError),
        ({"columns": ("front=a", "front=b")}, {}, InvalidOptionError),
        ({"columns": ("front=a",)}, {}, InvalidOptionError),
        ({"families_from": "no.csv"}, {}, InvalidOptionError),
        ({}, {"conditions": ("k0", "k0")}, InvalidOptionError),
        ({}, {"conditions": ("x3",)}, InvalidIdError),
        ({}, {"position_limit": "many"}, InvalidOptionError),
        ({}, {"conditions": ("k63",)}, BuildError),
        ({"parts": ("shifted",)}, {}, InvalidOptionError),  # the sample has no lamps
        ({"source": ("sample:MoveCube",)}, {}, BuildError),
        ({"parts": ("demonstrations",)}, {}, InvalidOptionError),
        ({"source": ()}, {}, InvalidOptionError),
        ({"only": "nothing"}, {}, InvalidOptionError),
        ({"only": "executions", "parts": ("shifted",)}, {}, InvalidOptionError),
        ({"only": "demonstrations"}, {"conditions": ("k0",)}, InvalidOptionError),
        ({"only": "demonstrations", "unit": "5x5"}, {}, InvalidOptionError),
        ({"only": "distractors", "episodes": "0", "unit_episodes": "1"}, {}, InvalidOptionError),
        ({"only": "manifests"}, {}, InvalidOptionError),  # which needs no source
        ({"only": "questions", "source": (), "cameras": ("front",)}, {}, InvalidOptionError),
    ],
)
def test_build_all_checks_options_before_it_reads(
    tmp_path: Path, changes: dict[str, Any], plan: dict[str, Any], error: type[InterferenceError]
) -> None:
    asked = {"source": ("sample",), "buffer_set": tmp_path / "out", **changes}
    with pytest.raises(error):
        plan_build(BuildConfig(**asked), BuffersConfig(**plan))
    assert list(tmp_path.iterdir()) == []


def test_manifests_need_datasets(tmp_path: Path) -> None:
    manifests = BuildConfig(tmp_path, only="manifests")
    with raises(MissingFileError) as caught:
        plan_build(manifests, BuffersConfig())
    assert f"{tmp_path} --only demonstrations" in str(caught.value.command)
    staging_path(tmp_path / "demonstrations").mkdir()
    with raises(MissingFileError) as caught:
        plan_build(manifests, BuffersConfig())
    assert caught.value.command is None  # only its builder knows the command that goes on


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "out"
    root.mkdir()
    (root / ".hidden").touch()
    plan_dataset("distractors", config(tmp_path))
    (root / "thesis.txt").write_text("mine")
    with raises(BuildError):
        plan_dataset("distractors", config(tmp_path))
    staging_path(root / "demonstrations").mkdir()  # a build has begun: the file came later
    plan_dataset("distractors", config(tmp_path))
    file = BuildConfig(source=("sample",), buffer_set=root / "thesis.txt")
    with raises(BuildError):
        plan_dataset("distractors", file)


@pytest.mark.parametrize("name", ["demonstrations", "distractors", "manifests"])
def test_build_all_rejects_folders_with_unknown_files(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "out" / name
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("mine")
    with raises(BuildError):
        plan_build(config(tmp_path), BuffersConfig())


def test_an_error_about_filters_shows_what_there_is() -> None:
    names = ("A/train/0", "A/train/1", "A/train/4", "B/test/2")
    with pytest.raises(SourceError) as caught:
        choose_episodes([made_up(*names)], numbers=range(50, 61))
    assert "train A 0-1,4, test B 2" in str(caught.value.hint)
