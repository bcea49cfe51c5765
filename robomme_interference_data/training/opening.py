"""Opening a `HistoryDataset`: its arguments are checked, and the datasets that it needs."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import DEMONSTRATIONS, EXECUTIONS, SHIFTED
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.loading import open_cache, open_dataset
from robomme_interference_data.data.state_reader import other_state_sizes, query_state_size
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import whole_number
from robomme_interference_data.schema.conditions import datasets_of, parse_condition
from robomme_interference_data.schema.other_states import check_rule, check_sizes
from robomme_interference_data.schema.shifts import NO_SHIFT, parse_shift

from .layout import LAYOUTS
from .rows import StoredRows

if TYPE_CHECKING:
    import os

    from robomme_interference_data.storage.cache import DecodedCache

_NO_ACTIONS = "Items without actions (chunk=0) need no executions."


def check_arguments(given: Mapping[str, Any], shifts: Sequence[str]) -> None:
    """Check arguments of a `HistoryDataset`, by name, and some against each other.

    Args:
        given: The arguments.
        shifts: The names among the weights of `shifts`.
    """
    for name in ("cameras", "families"):
        if isinstance(given[name], str):
            expected = f"a list of names: [{given[name]!r}]"
            raise InvalidOptionError.expected(name, given[name], expected)
    if given["layout"] not in LAYOUTS:
        raise InvalidOptionError.one_of("layout", given["layout"], LAYOUTS)
    for name, default, needed in (
        ("unit_episodes", None, "redraw"),
        ("retrieval_rule", "max", "retrieval"),
        ("retrieval_camera", None, "retrieval"),
    ):
        if given[name] != default and not given[needed]:
            raise InvalidOptionError(
                f"{name} has no effect without {needed}", f"Set {needed}, or leave {name} out."
            )
    for name in shifts:
        parse_shift(name)
    if shifts != (NO_SHIFT,) and given["chunk"]:
        expected = "none with actions: only first live observations are stored under shifts"
        raise InvalidOptionError.expected("shifts", list(shifts), expected)


def open_rows(
    buffer_set: BufferSet,
    conditions: Sequence[str],
    cameras: Sequence[str],
    *,
    image_size: int | None,
    other_states: str,
    cache: "bool | str | os.PathLike[str] | DecodedCache",
    actions: bool,
    shifts: bool,
    planned: bool,
) -> StoredRows:
    """Open the datasets whose frames items can have, checked before any frame is read.

    Args:
        buffer_set: The buffer set.
        conditions: Names of the conditions.
        cameras: Features of the cameras.
        image_size: Side of the images in pixels; None for no change of size.
        other_states: Rule for states of units of another robot.
        cache: See `HistoryDataset`.
        actions: Whether items have actions, which executions hold.
        shifts: Whether items have first live observations under shifts.
        planned: Whether histories are the planned ones.
    """
    datasets = _needed_datasets(
        buffer_set, conditions, actions=actions, shifts=shifts, planned=planned
    )
    buffer_set.check_tables(conditions, planned=planned)
    for dataset in datasets.values():
        dataset.check_records()
    kept = open_cache(cache)
    if kept is None:
        raise InvalidOptionError.expected("cache", cache, "True, a folder or a DecodedCache")
    size = _check_size(buffer_set, cameras, image_size)
    rule, others = check_rule(other_states), dict[str, int]()
    if any(parse_condition(name).k for name in conditions):
        others = other_state_sizes(datasets)
    what = f"HistoryDataset of {buffer_set.name}"
    check_sizes(what, query_state_size(datasets), others, rule)
    return StoredRows(datasets, kept, size, rule)


def _needed_datasets(
    buffer_set: BufferSet, conditions: Sequence[str], *, actions: bool, shifts: bool, planned: bool
) -> dict[str, Dataset]:
    """Return the datasets whose frames items can have, by name."""
    parsed = [parse_condition(name) for name in conditions]
    datasets = {name: open_dataset(buffer_set, name) for name in datasets_of(parsed)}
    if actions:
        datasets[EXECUTIONS] = open_dataset(buffer_set, EXECUTIONS, _NO_ACTIONS)
    if shifts:
        datasets[SHIFTED] = open_dataset(buffer_set, SHIFTED)
    if planned:
        for condition in parsed:
            buffer_set.planned(condition)
    return datasets


def _check_size(buffer_set: BufferSet, cameras: Sequence[str], size: int | None) -> int | None:
    """Check that the frames of cameras can be resized to squares of a size."""
    demonstrations = buffer_set.datasets[DEMONSTRATIONS]
    shapes = {one: demonstrations.shape(demonstrations.camera(one, "cameras")) for one in cameras}
    if size is None:
        return None
    size = whole_number("image_size", size, "an integer from 1, or None", 1)
    for camera, (height, width, _) in shapes.items():
        if size > min(height, width):
            expected = f"1 to {min(height, width)}: {camera} has {width}×{height} pixels"
            raise InvalidOptionError.expected("image_size", size, expected)
    return size
