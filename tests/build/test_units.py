"""Units of another length and stride than the paper's, for episodes that are shorter."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import violations
from support.made_up import MadeUpSource
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.config import BuildConfig
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.frame_selection import (
    NothingToStore,
    select_unit,
)
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan, PlannedEpisode
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan.datasets import plan_dataset
from robomme_interference_data.build_dataset.plan.parts import plan_alone
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.build_dataset.sources.base import Frame
from robomme_interference_data.cards.dataset_facts import buffer_set_facts
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.render import card_text
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    RAW_DISTRACTORS,
    Unit,
)
from robomme_interference_data.errors import BuildError, InvalidOptionError, SourceError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.text import read_json

QUERIES = {f"{family}/test/0": (12, 5) for family in ("Lift", "Stack")}
TRAIN = {f"{family}/train/0": (11, None) for family in ("Lift", "Stack")}
SHORT = Unit(4, 3)  # raw frames 0, 3, 6, 9; at full rate up to 12


def steps(kind: str, length: int, unit: Unit = SHORT) -> list[int]:
    frames = (Frame({}, np.array([n], np.float32), None, None) for n in range(length))
    return [int(frame.state[0]) for frame in select_unit(frames, kind, unit)]


def test_a_unit_is_of_the_chosen_frames() -> None:
    assert SHORT.raw_frames == 10
    assert steps(DISTRACTORS, 10) == steps(DISTRACTORS, 50) == [0, 3, 6, 9]
    assert steps(RAW_DISTRACTORS, 10) == [*range(10)]
    assert steps(RAW_DISTRACTORS, 50) == [*range(12)]
    assert steps(DISTRACTORS, 3, Unit(1, 8)) == [0]
    for kind in (DISTRACTORS, RAW_DISTRACTORS):
        with raises(NothingToStore):
            steps(kind, 9)


def build(root: Path, kind: str, lengths: dict[str, Any], unit: Unit = SHORT) -> None:
    source = MadeUpSource(lengths)
    episodes = tuple(PlannedEpisode(0, episode) for episode in source.episodes())
    plan = DatasetPlan(kind, (source,), episodes, unit=unit)
    build_dataset(plan, root / kind, Serial(), WorkProgress(quiet=True))


@pytest.mark.slow
def test_a_buffer_set_of_short_units(tmp_path: Path) -> None:
    for kind, lengths in ((DEMONSTRATIONS, QUERIES), (DISTRACTORS, TRAIN)):
        build(tmp_path, kind, lengths)
    build(tmp_path, RAW_DISTRACTORS, TRAIN, Unit(4, 2))
    conditions = ("k0", "k1", "held-k1", "raw-k1")
    with raises(SourceError):
        plan_manifests(datasets_in(tmp_path), conditions)
    with raises(BuildError):
        build(tmp_path, RAW_DISTRACTORS, TRAIN)
    (tmp_path / RAW_DISTRACTORS).rename(tmp_path.with_name("other"))
    build(tmp_path, RAW_DISTRACTORS, TRAIN)
    list(write_manifests(plan_manifests(datasets_in(tmp_path), conditions), tmp_path))
    opened = load_buffer_set(tmp_path)
    # The lesson of 5 frames; then a unit of 4, its last frame 4 times, or its 11 raw frames.
    assert [len(opened.load("Lift/test/0", one)) for one in conditions] == [5, 9, 9, 16]
    assert opened.datasets[DISTRACTORS].identity.unit == {"frames": 4, "stride": 3}
    assert violations(tmp_path) == []
    text = card_text(buffer_set_facts(opened), Publication("me/short", "1.0.0"))
    assert "the first 12 raw frames of an episode of another family at stride 3: 4 frames" in text
    assert "not the paper's 32 frames at stride 8: results are not comparable" in text
    path = tmp_path / DISTRACTORS / IDENTITY_PATH
    write_json(path, read_json(path) | {"unit": {"frames": 5, "stride": 3}})
    assert any("holds 4 frames, not 5" in one for one in violations(tmp_path))
    write_json(path, read_json(path) | {"unit": {"frames": 0, "stride": 3}})
    assert any("unit is {'frames': 0" in one for one in violations(tmp_path))


def test_only_short_episodes_are_an_error_that_names_the_options(tmp_path: Path) -> None:
    with raises(SourceError) as caught:
        build(tmp_path, DISTRACTORS, TRAIN, Unit(32, 8))
    assert "`unit`" in str(caught.value.hint)
    assert not (tmp_path / DISTRACTORS).exists()
    for text in ("0x8", "32", "5x", "-1x1"):
        config = BuildConfig(source=("sample",), buffer_set=tmp_path, unit=text)
        with pytest.raises(InvalidOptionError) as caught:
            plan_dataset(DISTRACTORS, config)
        assert caught.value.option == "unit"
    other = BuildConfig(source=("sample",), buffer_set=tmp_path, unit="5x8")
    with pytest.raises(InvalidOptionError) as caught:
        plan_alone("demonstrations", other)
    assert caught.value.option == "unit"


@pytest.mark.parametrize("split", ["test", "val"])
def test_units_of_other_splits_are_an_error_before_anything_is_written(
    split: str, tmp_path: Path, run: Any
) -> None:
    root, source = tmp_path / "set", ("--source", "sample:Cup,Drawer")
    for part in (("--only", "distractors"), ("--only", "distractors-raw")):
        code, _, err = run("build", root, *part, "--split", split, *source, "--json")
        error = json.loads(err)
        assert (code, error["type"]) == (1, "InvalidOptionError")
        assert error["command"].split()[1:] == ["build", str(root), *part, *source]
    assert not root.exists()
