"""Whole builds in one process: output, resuming, extending, and invalid inputs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, contents
from support.made_up import MadeUpSource
from support.messages import raises

from robomme_interference_data.build_dataset.dataset.build import BuildResult, build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.sources import Robot, Source
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.constants import FRONT
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import (
    BuildError,
    InterferenceError,
    InvalidOptionError,
    SourceError,
)
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.staging import file_lock, staging_path
from robomme_interference_data.storage.text import read_json

TRAIN = {f"{family}/train/{index}": (260, None) for family in ("A", "B") for index in range(2)}


def build(
    out: Path, *sources: Source, kind: str = "distractors", filters: Any = None, **options: Any
) -> BuildResult:
    tasks = choose_episodes(sources, **(filters or {}))
    plan = DatasetPlan(kind, sources, tasks, **options)
    return build_dataset(plan, out, Serial(), WorkProgress(quiet=True))


def ids(root: Path) -> list[str]:
    return [str(one.episode_id) for one in Dataset(LocalFiles(root)).records()]


@pytest.mark.slow
def test_the_golden_units_come_out_again_and_grow_to_the_same_bytes(tmp_path: Path) -> None:
    """In three steps, the later episodes first, as in one: videos are taken over as they are."""
    out, golden = tmp_path / "out", GOLDEN / "distractors"
    source = SampleSource(size=32)

    def step(**filters: Any) -> BuildResult:
        return build(out, source, filters={"split": "train", **filters})

    some = step(numbers=(1,), families=("MoveCube", "VideoRepick", "RouteStick"))
    assert (some.episodes, some.added) == (2, 2)
    assert some.skipped == {"VideoRepick/train/1": "200 raw frames; a unit needs 249"}
    assert step(numbers=(0,)).added == 9
    whole = step(numbers=(0, 1))
    assert (whole.episodes, whole.added, whole.frames) == (17, 6, 17 * 32)
    assert contents(out) == contents(golden)
    again = step(numbers=(0, 1))
    assert (again.episodes, again.added) == (17, 0)
    assert contents(out) == contents(golden)
    assert not staging_path(out).exists()


def test_the_golden_demonstrations_hold_what_the_source_gives(tmp_path: Path) -> None:
    """Built without videos that were there before: the same hashes of the same frames."""
    out = tmp_path / "out"
    families = ("VideoRepick", "MoveCube", "PatternLock")
    filters = {"families": families, "split": "test"}
    build(out, SampleSource(size=32), kind="demonstrations", filters=filters)
    assert contents(out) == contents(GOLDEN / "demonstrations")


@pytest.mark.slow
def test_build_resumes_from_staged_episodes(tmp_path: Path) -> None:
    out = tmp_path / "out"
    source = MadeUpSource(TRAIN, {"B/train/0": {9: SourceError("broke off", "record it again")}})
    with raises(SourceError):
        build(out, source)
    assert not out.exists()
    for name in TRAIN:  # nothing but that one is read again
        source.wrong[name] = {0: SourceError("must not be read")}
    source.wrong["B/train/0"] = {}
    assert build(out, source).added == 4
    assert not staging_path(out).exists()
    build(tmp_path / "at once", MadeUpSource(TRAIN))
    assert contents(out) == contents(tmp_path / "at once")


def test_several_failures_are_listed(tmp_path: Path) -> None:
    wrong = {name: {3: SourceError("broke off")} for name in list(TRAIN)[1:]}
    with raises(BuildError) as caught:
        build(tmp_path / "out", MadeUpSource(TRAIN, wrong))
    listed = caught.value.message.splitlines()[1:]
    assert listed == ["  A/train/1, B/train/0, B/train/1: broke off"]
    assert "The others are kept" in str(caught.value.hint)


def test_failures_of_all_episodes_keep_their_hints(tmp_path: Path) -> None:
    wrong = {name: {3: SourceError("broke off", "Record it again.")} for name in TRAIN}
    wrong["A/train/0"] = {3: SourceError("is dark", "Lift the cap.")}
    with pytest.raises(BuildError) as caught:
        build(tmp_path / "out", MadeUpSource(TRAIN, wrong))
    assert len(caught.value.message.splitlines()) == 3
    hints = str(caught.value.hint).splitlines()
    assert hints[:2] == ["Lift the cap.", "Record it again."]
    assert "The others are kept." not in hints


def test_what_a_killed_build_had_moved_away_is_put_back(tmp_path: Path) -> None:
    out = tmp_path / "out"
    source = MadeUpSource(TRAIN)
    build(out, source, filters={"numbers": (0,)})
    staging_path(out).mkdir()
    out.rename(staging_path(out) / "before")  # killed between the two renames
    assert build(out, source).added == 2
    assert ids(out) == list(TRAIN)


def test_episodes_with_and_without_actions_mix(tmp_path: Path) -> None:
    out = tmp_path / "out"
    moving = MadeUpSource({"A/train/0": (260, None)})
    silent = MadeUpSource({"B/train/0": (260, None)}, actions=False)
    build(out, moving)
    assert "action" in Dataset(LocalFiles(out)).features
    build(out, moving, silent)  # grows, and drops what not all have
    dataset = Dataset(LocalFiles(out))
    assert "action" not in dataset.features
    assert all("action" not in one.feature_sha256 for one in dataset.records())
    build(tmp_path / "at once", silent, moving)
    assert contents(out) == contents(tmp_path / "at once")


def test_a_dataset_is_of_one_robot_and_keeps_what_it_is(tmp_path: Path) -> None:
    out = tmp_path / "out"
    robot = Robot(15, "aloha", {"observation.state": tuple("abcdefgh")})
    build(out, MadeUpSource({"A/train/0": (260, None)}, robot=robot))
    assert build(out, MadeUpSource({"A/train/1": (260, None)}, robot=robot)).added == 1
    info = read_json(out / "meta/info.json")
    assert (info["fps"], info["robot_type"]) == (15, "aloha")
    assert info["features"]["observation.state"]["names"] == list("abcdefgh")
    assert info["features"]["action"]["names"] is None  # unknown, and not invented
    others = {
        "frames per second: 15 in A/train/0, 10 in A/train/2": replace(robot, fps=10),
        "robot: aloha in A/train/0, unknown in A/train/3": replace(robot, type=None),
        "values of state: a, b, c, d, e, f, g, h in A/train/0, unknown in": Robot(15, "aloha"),
    }
    for number, (difference, other) in enumerate(others.items(), 2):
        with raises(SourceError) as caught:
            build(out, MadeUpSource({f"A/train/{number}": (260, None)}, robot=other))
        assert difference in caught.value.message and "{" not in caught.value.message


@pytest.mark.slow
@pytest.mark.parametrize("fps", [12.5, 30000 / 1001, 15.0, 0.5])
def test_a_frame_rate_is_kept_as_it_is(tmp_path: Path, fps: float) -> None:
    """LeRobot's files have it, LeRobot opens them, and the frames are the recorded ones."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    out, source = tmp_path / "out", MadeUpSource({"A/train/0": (260, 5)}, robot=Robot(fps))
    build(out, source)
    info = read_json(out / "meta/info.json")
    assert info["fps"] == fps and isinstance(info["fps"], int) == fps.is_integer()
    assert info["features"]["observation.images.front"]["info"]["video.fps"] == fps
    dataset = Dataset(LocalFiles(out))
    frames = [frame for frame in dataset.lerobot.iter_frames(0, FRONT, 0, dataset.record(0).length)]
    rest = source.read(source.episodes()[0], None).frames
    expected = [frame.images["front"] for frame in rest][:249:8]
    assert np.array_equal(frames, expected)
    opened = LeRobotDataset("any/name", root=out, video_backend="pyav")
    assert opened.fps == fps and len(opened) == 32
    assert opened[31]["timestamp"].item() == pytest.approx(31 / fps)
    image = (opened[31][FRONT].permute(1, 2, 0) * 255).round().byte().numpy()
    assert np.array_equal(image, expected[31])


@pytest.mark.parametrize(
    ("recorded", "given", "kept"),
    [
        (None, None, None),
        (None, 12.5, 12.5),
        (15.0, None, 15.0),
        (15.0, 15.0, 15.0),
        (15, 10, None),
    ],
)
def test_an_unknown_frame_rate_is_given_or_an_error(
    tmp_path: Path, recorded: float | None, given: float | None, kept: float | None
) -> None:
    source = MadeUpSource({"A/train/0": (260, 5)}, robot=Robot(recorded))
    if kept is None:
        with pytest.raises(SourceError):
            build(tmp_path / "out", source, fps=given)
        assert not (tmp_path / "out").exists()
    else:
        build(tmp_path / "out", source, fps=given)
        assert Dataset(LocalFiles(tmp_path / "out")).fps == kept


def test_names_are_one_for_each_value(tmp_path: Path) -> None:
    for names in (tuple("abcdefg"), tuple("abcdefgg")):
        robot = Robot(10, names={"observation.state": names})
        with pytest.raises(SourceError):
            build(tmp_path / "out", MadeUpSource({"A/train/0": (260, 5)}, robot=robot))


def test_what_cannot_follow_the_demonstrations_is_refused_before_it_is_built(
    tmp_path: Path,
) -> None:
    demonstrations = MadeUpSource({"A/test/0": (20, 5)}, robot=Robot(15))
    build(tmp_path / "set/demonstrations", demonstrations, kind="demonstrations")
    base = Dataset(LocalFiles(tmp_path / "set/demonstrations"))
    out = tmp_path / "set/distractors"
    slow = MadeUpSource({"B/train/0": (260, None)}, robot=Robot(10))
    two = MadeUpSource({"B/train/1": (260, None)}, robot=Robot(15), cameras=("front", "top"))
    clauses = {
        "frames per second: 15 in the demonstrations, 10 in B/train/0": (slow, False),
        "camera top: missing in the demonstrations, 24×16 pixels in B/train/1": (two, True),
    }
    for clause, (source, cameras_help) in clauses.items():
        plan = DatasetPlan("distractors", (source,), choose_episodes((source,))).matching(base)
        with pytest.raises(SourceError) as caught:
            build_dataset(plan, out, Serial(), WorkProgress(quiet=True))
        assert clause in caught.value.message
        assert ("`cameras`" in str(caught.value.hint)) == cameras_help
        assert not out.exists() and not staging_path(out).exists()


TABLETOP = {"kind": "tabletop", "versions": {"tabletop": "1", "sapien": "3.0.3"}, "renderer": "A"}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one episode of one camera."""
    out = tmp_path_factory.mktemp("built") / "out"
    build(out, MadeUpSource({"A/train/0": (260, 5)}, provenance=TABLETOP))
    return out


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ({}, {"codec": "lerobot-default"}, "with other settings"),
        ({}, {"version": "2.0.0"}, "with other settings"),
        ({}, {"kind": "demonstrations"}, "with other settings"),
        ({"cameras": ("front", "wrist")}, {}, "cannot be in one dataset"),
        ({"provenance": TABLETOP | {"renderer": "B"}}, {}, "renderer: A in it, B in this build"),
        (
            {"provenance": TABLETOP | {"versions": {"tabletop": "1", "sapien": "3.0.4"}}},
            {},
            "sapien: 3.0.3 in it, 3.0.4 in this build",
        ),
        ({"provenance": TABLETOP | {"versions": {"tabletop": "1"}}}, {}, "missing in this build"),
    ],
)
def test_dataset_with_other_settings_is_unchanged(
    built: Path, source: dict[str, Any], options: dict[str, Any], message: str
) -> None:
    before = contents(built)
    other = MadeUpSource({"A/train/1": (260, 5)}, **source)
    with raises(InterferenceError) as caught:
        build(built, other, **options)
    assert message in caught.value.message
    assert "settings" not in message or "Choose another `buffer_set`" in str(caught.value.hint)
    assert contents(built) == before


def test_an_interrupted_build_resumes_with_the_same_renderer_only(tmp_path: Path) -> None:
    out, lengths = tmp_path / "out", {"A/train/0": (260, 5), "B/train/0": (260, 5)}
    broken = {"B/train/0": {7: SourceError("it ends here")}}
    with pytest.raises(SourceError):
        build(out, MadeUpSource(lengths, broken, provenance=TABLETOP))
    with raises(BuildError) as caught:
        build(out, MadeUpSource(lengths, provenance=TABLETOP | {"renderer": "B"}))
    assert "interrupted build" in caught.value.message and "renderer: A in it" in str(caught.value)
    assert str(staging_path(out)) in str(caught.value.hint)
    assert not out.exists()
    assert build(out, MadeUpSource(lengths, provenance=TABLETOP)).episodes == 2
    assert Dataset(LocalFiles(out)).identity.sources == (TABLETOP,)


def test_episodes_of_other_cameras_mix_in_those_that_all_have(tmp_path: Path) -> None:
    one = MadeUpSource({"A/train/0": (260, None)})
    both = MadeUpSource({"B/train/0": (260, None)}, cameras=("front", "wrist"))
    with raises(SourceError) as caught:
        build(tmp_path / "out", one, both)
    assert "`cameras`" in str(caught.value.hint)
    assert build(tmp_path / "out", one, both, cameras=("front",)).episodes == 2


def test_what_cannot_follow_an_existing_dataset_leaves_nothing(tmp_path: Path) -> None:
    slow = MadeUpSource({"B/train/0": (260, None)}, robot=Robot(5))
    with pytest.raises(SourceError) as caught:  # one of both fits: it is kept
        build(tmp_path / "both", MadeUpSource({"A/train/0": (260, None)}), slow)
    assert "cameras" not in str(caught.value.hint)
    assert staging_path(tmp_path / "both").is_dir()
    build(tmp_path / "out", MadeUpSource({"A/train/0": (260, None)}))
    with pytest.raises(SourceError):
        build(tmp_path / "out", slow)
    assert not staging_path(tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("robot", "options", "error"),
    [
        (Robot(10), {"fps": 10.0}, None),
        (Robot(10), {"fps": 5.0}, InvalidOptionError),
        (Robot(5), {}, SourceError),
        (Robot(None), {}, None),
    ],
)
def test_what_is_built_again_must_be_the_same(
    robot: Robot, options: dict[str, Any], error: type[InterferenceError] | None, tmp_path: Path
) -> None:
    build(tmp_path / "out", MadeUpSource({"A/train/0": (260, None)}))
    again = MadeUpSource({"A/train/0": (260, None)}, robot=robot)
    if error is None:
        assert build(tmp_path / "out", again, **options).added == 0
    else:
        with pytest.raises(error):
            build(tmp_path / "out", again, **options)


def test_unknown_files_and_concurrent_builds(tmp_path: Path) -> None:
    source = MadeUpSource(TRAIN)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with raises(BuildError):
        build(tmp_path / "mine", source)
    assert contents(tmp_path / "mine") == {"notes.txt": b"keep"}
    work = staging_path(tmp_path / "out")
    work.mkdir()
    with file_lock(work / "lock", BuildError("x")), raises(BuildError):
        build(tmp_path / "out", source)


def test_no_dataset_under_a_name_that_is_not_utf_8(tmp_path: Path) -> None:
    with raises(InvalidOptionError):
        build(tmp_path / "caf\udce9" / "out", MadeUpSource(TRAIN))
    assert not any(tmp_path.iterdir())
