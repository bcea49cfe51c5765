"""Which columns of a LeRobot dataset are used. Pure rules."""

from typing import Any

import pytest
from support.messages import raises

from robomme_interference_data.build_dataset.sources.lerobot.columns import (
    RecordedColumns,
    find_columns,
    value_names,
)
from robomme_interference_data.errors import InvalidOptionError, SourceError, UnknownNameError


def vector(size: int, dtype: str = "float32", names: Any = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [size], "names": names}


def video(height: int = 480, width: int = 640, **info: Any) -> dict[str, Any]:
    return {"dtype": "video", "shape": [height, width, 3], "info": info}


COUNTERS = {
    "timestamp": vector(1),
    **{
        name: vector(1, "int64") for name in ("frame_index", "episode_index", "index", "task_index")
    },
}
FRONT = {"observation.images.front": video()}
HSR = {
    "observation.image.head": video(),
    "observation.image.hand": video(),
    "observation.state": vector(8),
    "action.absolute": vector(8),
    "action.relative": vector(11),
    **COUNTERS,
}
AGIBOT = {
    "observation.images.head": video(),
    "observation.images.head_depth": {"dtype": "image", "shape": [480, 640, 1]},
    "observation.states.joint.position": vector(14),
    "observation.states.effector.position": vector(2),
    "actions.joint.position": vector(14),
    "actions.effector.position": vector(2),
    **COUNTERS,
}


def found(features: dict[str, Any], **given: str) -> RecordedColumns:
    return find_columns(features, given, "here")


def test_cameras_are_named_after_their_columns() -> None:
    features = {
        "observation.image.head": video(),
        "observation.images.color.left": video(),
        "images/top": video(),
        "observation.exterior_image_1_left": video(),
        "observation.state": vector(2),
    }
    assert found(features).cameras == {
        "head": "observation.image.head",
        "color_left": "observation.images.color.left",
        "images_top": "images/top",
        "exterior_image_1_left": "observation.exterior_image_1_left",
    }
    assert found(features, head="none").cameras.keys() == {
        "color_left",
        "images_top",
        "exterior_image_1_left",
    }
    with raises(SourceError):  # two of one name
        found(features | {"observation.images.head": video()})


@pytest.mark.parametrize("flag", [True, "true", "True"])
@pytest.mark.parametrize("key", ["is_depth_map", "video.is_depth_map"])
def test_depth_maps_are_no_cameras(flag: Any, key: str) -> None:
    features = FRONT | {"depth": video(**{key: flag}), "observation.state": vector(2)}
    assert found(features).cameras == {"front": "observation.images.front"}
    with raises(SourceError):
        found(features, depth="depth")


def test_depth_flags_that_are_false() -> None:
    features = {"observation.images.front": video(**{"video.is_depth_map": "false"})}
    assert found(features).cameras.keys() == {"front"}


def test_a_set_without_states_or_actions_is_read_without() -> None:
    assert found(FRONT | COUNTERS) == RecordedColumns({"front": "observation.images.front"})


def test_columns_that_may_be_the_state_need_a_choice() -> None:
    with raises(SourceError) as caught:
        found(AGIBOT)
    joined = "observation.states.joint.position+observation.states.effector.position"
    assert f"state={joined}" in str(caught.value.hint)
    with raises(SourceError) as caught:
        found(AGIBOT, state=joined)
    action = "actions.joint.position+actions.effector.position"
    assert f"action={action}" in str(caught.value.hint)
    columns = found(AGIBOT, state=joined, action=action)
    assert (columns.state, columns.action) == (tuple(joined.split("+")), tuple(action.split("+")))
    assert columns.cameras.keys() == {"head"}
    without = found(AGIBOT, state="none", action="none")
    assert (without.state, without.action) == ((), ())


def test_a_usual_name_needs_no_choice() -> None:
    features = HSR | {"action": vector(8), "observation.wrench": vector(6)}
    assert found(features).vectors == {
        "observation.state": ("observation.state",),
        "action": ("action",),
    }
    assert found(HSR, action="action.relative").action == ("action.relative",)
    with raises(SourceError):
        found(HSR)


@pytest.mark.parametrize("dtype", ["float64", "float16", "int64", "uint8"])
def test_numbers_of_any_type_are_vectors(dtype: str) -> None:
    features = FRONT | {"observation.state": vector(3, dtype)}
    assert found(features).state == ("observation.state",)


def test_a_column_may_have_a_plus_in_its_name() -> None:
    features = FRONT | {"a+b": vector(2), "a": vector(1), "none": vector(4)}
    assert found(features, state="a+b").state == ("a+b",)
    assert found(features, state="a+none").state == ("a", "none")
    assert found(features, state="none").state == ("none",)


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({"state": "arm+griper"}, UnknownNameError),
        ({"state": "arm+arm"}, InvalidOptionError),
        ({"state": "arm+label"}, SourceError),
        ({"front": "arm+label"}, InvalidOptionError),
        ({"state": "arm+"}, UnknownNameError),
        ({"../x": "observation.images.front"}, InvalidOptionError),
        ({"subgoal": "arm"}, SourceError),
        ({"front": "none"}, SourceError),
    ],
)
def test_given_columns_that_are_wrong(given: dict[str, str], error: Any) -> None:
    features = FRONT | {"arm": vector(2), "gripper": vector(1), "label": vector(1, "string")}
    with raises(error):
        found(features, **given)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["x", "y"], ("x", "y")),
        ({"axes": ["x", "y"]}, ("x", "y")),
        ({"groups": ["arm"], "motors": ["x", "y"]}, ("x", "y")),
        ({"y": 1, "x": 0}, ("x", "y")),
        ([["x", "y"]], ("x", "y")),
        (None, None),
        (["x", "x"], None),
        (["position"], None),
        ({"a": ["x", "y"], "b": ["u", "v"]}, None),
        ([1, 2], None),
        ({"x": 0, "y": 2}, None),
    ],
)
def test_names_of_values(names: Any, expected: tuple[str, ...] | None) -> None:
    assert value_names({"arm": vector(2, names=names)}, ["arm"]) == expected


def test_names_of_joined_values() -> None:
    features = {
        "end.position": vector(2, names=["left", "right"]),
        "grip": vector(1, names=["opening"]),
        "end.force": vector(2, names={"axes": ["left", "right"]}),
        "other": vector(1),
    }
    assert value_names(features, ["end.position", "grip"]) == ("left", "right", "opening")
    assert value_names(features, ["grip", "end.position", "end.force"]) == (
        "grip.opening",
        "end.position.left",
        "end.position.right",
        "end.force.left",
        "end.force.right",
    )
    assert value_names(features, ["grip", "other"]) is None
