"""A map-style PyTorch dataset of moments in executions, each with the memory of its history."""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, DEMONSTRATIONS, EXECUTIONS, STATE
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import camera_feature
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import HashMismatchError, InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId, parse_numbers, whole_number
from robomme_interference_data.retrieval.stored_selector import StoredSelector
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.sampling import Memory, spread
from robomme_interference_data.schema.shifts import NO_SHIFT
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.text import digest_json

from .batches import Batches
from .draws import Weights
from .epoch import Epoch
from .histories import Histories
from .image_transforms import transform_images
from .item_draws import ItemDraws
from .layout import LeRobotMeta, describe, renamed
from .loaders import Items, item_of, made_or_unusable
from .moments import choose_moments
from .opening import check_arguments, open_rows
from .question_tensors import QuestionTensors

if TYPE_CHECKING:
    from robomme_interference_data.storage.cache import DecodedCache


class HistoryDataset:
    """Moments of executions, with the memory that a policy has at that step of a rollout.

    Item `i` is moment t of an execution, the part of an episode after its lesson. Its history is
    the buffer of the episode under a condition that is drawn from `conditions`; its memory is what
    the rule `memory` keeps of the history and the live frames before t. Everything that is drawn
    follows from `seed`, the epoch and the index: items are the same for any number of workers and
    ranks, in any order. Frames come from the cache of decoded frames, which the first use fills.

    An item has, with M memory frames, images of S × S pixels (or the recorded height and width),
    states of D values, actions of A, and P the most parts of an answer:

    - `observation.images.<camera>`: `(3, S, S) uint8` RGB, the current frame;
    - `observation.state`: `(D,) float32`: 7 joint positions in rad, opening of a finger in m;
    - `memory.images.<camera>`: `(M, 3, S, S) uint8`, the frames in memory, oldest first;
    - `memory.state`: `(M, D) float32`;
    - `memory.position`: `(M,) int64`, index of each frame in history and execution together;
    - `memory.is_pad`: `(M,) bool`, True for the places after the last frame, which are 0;
    - `memory.evidence`: `(M, P) bool`, which parts of the hidden answer each frame shows; and
      `evidence_known`: `() bool`, False where that is unknown;
    - `position`: `() int64`, index of the current frame in history and execution together;
    - `action`: `(chunk, A) float32`, the actions executed from the current frame on, and
      `action_is_pad`: `(chunk,) bool`, True after the last one, which is repeated;
    - with `questions`, for O options with at most P points: `question` and
      `question.options` (O texts, `""` where only the points show it), `question.points`:
      `(O, P, 2) float32`, (y, x) as fractions of the front image's height and width,
      `question.point_is_pad`: `(O, P) bool`, `question.option_is_pad`: `(O,) bool`, and
      `question.answer`: `() int64`, the index of the right option;
    - `task`: the goal; `condition`, `shift`, `episode_id`: text;
    - `frame_index`: `() int64`, t; `index`: `() int64`, the item's index.

    Several indices (a list, tuple, slice, array or tensor) give a batch, with all entries as
    `default_collate` makes them of the items, but faster. `DataLoader(data, batch_size)` gets its
    batches in this way.

    Args:
        buffer_set: Folder, `namespace/name` on the Hub, or a `BufferSet`.
        conditions: Names of conditions with the weights to draw them, or names with equal weights.
        memory: `framesamp:N`, `window:N`, `window:SECONDS@FPS` or `full`; N counts the current
            frame. See `Memory`.
        cameras: Cameras of current and memory frames, possibly none of them; None for the first.
        image_size: Side of the images in pixels, see `resize`; None for no change of size.
        chunk: Actions per item. If 0, items have no actions and there is one per episode: the
            first live moment. Then the buffer set needs no executions.
        split: Split of the query episodes to use. Train on no others than `train`.
        families: Families to use; empty for all.
        episodes: Indices of the query episodes to use, such as `0-79`; None for all.
        retrieval: Encoder of a retrieval step before the memory, such as `thumbnail`; its index
            must be stored. `retrieval_rule` and `retrieval_camera` are those of `evaluate`.
        shifts: Shifts of the first live observation, with weights; needs the dataset `shifted`
            and `chunk=0`, since only first observations are stored.
        questions: Whether items have the question about the past, see `build --only questions`.
        redraw: Draw the sessions of the conditions anew in every epoch, instead of the planned
            ones. Then conditions need not be planned.
        unit_episodes: With `redraw`, indices of the train episodes whose units may be drawn, such
            as `0-5`, so that others can be kept for testing; None for all.
        other_states: What to do with states of units of another robot, with another number of
            values than the query's: `refuse`, `pad` (zeros after fewer values) or `omit` (zeros).
        seed: Seed of everything that is drawn.
        cache: Where decoded frames are kept: a `DecodedCache`, a folder for one of 20 GiB, or True
            for the folder `~/.cache/robomme-interference`.
        layout: Names of an item's entries: `plain`, the above; or `lerobot`, below `observation.`
            what a policy may see (`observation.memory.padding`, `observation.position`) and below
            `label.` what it must not (`label.evidence`, `label.answer`, `label.condition`).
        image_transforms: Random change of an item's images, from `(M + 1, 3, S, S) float32`, 0 to
            1, to the same: those in memory and the current one, which it must change alike.
        quiet: Show no progress.

    Raises:
        MissingFileError: The buffer set, a dataset that is needed (executions, shifted, a
            condition's), or an index is missing.
        UnknownNameError: A condition is not planned; there is no such camera, family or rule.
        InvalidOptionError: Another argument has an invalid value.
        HashMismatchError: Frames differ from the recorded ones.
    """

    def __init__(
        self,
        buffer_set: "str | os.PathLike[str] | BufferSet",
        conditions: Mapping[str, float] | Sequence[str],
        *,
        memory: str = "framesamp:32",
        cameras: Sequence[str] | None = None,
        image_size: int | None = None,
        chunk: int = 16,
        split: str = "train",
        families: Sequence[str] = (),
        episodes: str | None = None,
        retrieval: str | None = None,
        retrieval_rule: str = "max",
        retrieval_camera: str | None = None,
        shifts: Mapping[str, float] | None = None,
        questions: bool = False,
        redraw: bool = False,
        unit_episodes: str | None = None,
        other_states: str = "refuse",
        seed: int = 0,
        cache: "bool | str | os.PathLike[str] | DecodedCache" = True,
        layout: str = "plain",
        image_transforms: Callable[[torch.Tensor], torch.Tensor] | None = None,
        quiet: bool = False,
    ):
        opened = isinstance(buffer_set, BufferSet)
        self.buffer_set: BufferSet = buffer_set if opened else load_buffer_set(buffer_set)  # type: ignore[assignment,arg-type]
        if cameras is None:
            cameras = (self.buffer_set.datasets[DEMONSTRATIONS].camera(),)
        self._arguments = dict(
            conditions=conditions, memory=memory, cameras=cameras, image_size=image_size,
            chunk=chunk, split=split, families=families, episodes=episodes,
            retrieval=retrieval, retrieval_rule=retrieval_rule, retrieval_camera=retrieval_camera,
            shifts=shifts, questions=questions, redraw=redraw, unit_episodes=unit_episodes,
            other_states=other_states, seed=seed, cache=cache, layout=layout,
            image_transforms=image_transforms,
        )  # fmt: skip
        self._conditions = Weights.parse("conditions", conditions)
        shift_weights = Weights.parse("shifts", shifts or {NO_SHIFT: 1})
        check_arguments(self._arguments, shift_weights.names)
        self.layout, self._image_transforms = layout, image_transforms
        self.memory, self.seed = Memory.parse(memory), seed
        self.chunk = whole_number("chunk", chunk, "an integer from 0", 0)
        self.cameras = tuple(camera_feature(camera) for camera in cameras)
        units = None if unit_episodes is None else frozenset(parse_numbers(unit_episodes))
        step = (
            StoredSelector(retrieval, rule=retrieval_rule, camera=retrieval_camera)
            if retrieval
            else None
        )
        actions = self.chunk > 0
        self._rows = open_rows(
            self.buffer_set,
            self._conditions.names,
            self.cameras,
            image_size=image_size,
            other_states=other_states,
            cache=cache,
            actions=actions,
            shifts=shift_weights.names != (NO_SHIFT,),
            planned=not redraw,
        )
        self._moments = choose_moments(
            self.buffer_set, self._rows, split, families, episodes, actions=actions
        )
        self._histories = Histories(
            self.buffer_set, self._rows, step, (seed, units) if redraw else None
        )
        self._questions = QuestionTensors(self.buffer_set, self.episode_ids) if questions else None
        self._draws = ItemDraws(
            self.buffer_set,
            self._rows,
            self._moments,
            self._histories,
            self._conditions,
            shift_weights,
            seed,
        )
        if not redraw:
            self._histories.plan(
                self._conditions.names, self.episode_ids, self._draws.shifts.values(), quiet=quiet
            )
        # Here, not when they are first used: a loader's forked workers share what is open now.
        now = self._draws.live_rows
        self._used = np.concatenate([now, self._histories.rows_in_use(self.episode_ids)])
        self._rows.prepare((*self.cameras, STATE), self._used, quiet=quiet)
        if actions:
            self._rows.prepare((ACTION,), now, quiet=quiet)
        self._batches = Batches(
            self._rows,
            self._moments,
            self.memory,
            self.cameras,
            self.chunk,
            self.memory_frames,
            self._histories.parts,
        )
        several = len(self._conditions.names) > 1 or len(shift_weights.names) > 1
        self._epoch = Epoch(len(self), draws=redraw or several)

    def __reduce__(self) -> tuple[Any, ...]:
        # Memory maps and tables cannot be pickled: another process opens the buffer set again. It
        # may have another working directory.
        files = self.buffer_set.files
        location = str(files.root.absolute()) if isinstance(files, LocalFiles) else files.location
        arguments = (location, self._arguments, self._epoch, self._identity)
        return made_or_unusable, (HistoryDataset._opened_again, *arguments)

    @classmethod
    def _opened_again(
        cls, location: str, arguments: dict[str, Any], epoch: Epoch, identity: str
    ) -> "HistoryDataset":
        made = cls(location, **arguments, quiet=True)
        # Items are numbered over all episodes: in a set that grew, an index means another moment.
        if made._identity != identity:
            raise HashMismatchError(
                f"{location} was changed since the training began: a worker finds other items",
                "Start the training again; do not change a buffer set that is in use.",
            )
        made._epoch = epoch
        return made

    @property
    def _identity(self) -> str:
        """Digest of header, episodes, and rows of the planned histories.

        If another process that opens the buffer set again finds the same, an index means the same
        item there.
        """
        rows = [self._moments.first, self._histories.rows]
        return digest_json(
            [
                to_dict(self.buffer_set.header),
                [str(episode) for episode in self.episode_ids],
                *(hashlib.sha256(numbers.tobytes()).hexdigest() for numbers in rows),
            ]
        )

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._moments)

    def __repr__(self) -> str:
        return (
            f"HistoryDataset({self.buffer_set.name}, conditions={list(self._conditions.names)}, "
            f"memory={self.memory}, episodes={len(self.episode_ids)}, items={len(self)})"
        )

    @property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of the query episodes in use, in canonical order."""
        return self._moments.episodes

    @property
    def memory_frames(self) -> int:
        """Number M of places in memory, without the current frame."""
        if self.memory.rule != "full":
            return self.memory.frames - 1
        longest = self._histories.longest(self._conditions.names, self.episode_ids)
        return longest + self._moments.most - 1

    def stored_values(self, feature: str, most: int | None = None) -> NDArray[Any]:
        """Return the values of a feature in all sessions and executions in use, `(N, …)`.

        Args:
            feature: `action`, `observation.state` or `observation.images.<camera>`.
            most: Most values, which are evenly spread; None for all.
        """
        used = self._moments.first if feature == ACTION else self._used
        rows = self._rows.of_same_sessions(used)
        return self._rows.take(feature, rows if most is None else rows[spread(0, len(rows), most)])

    # LeRobot's training reads these of a dataset: all episodes of `meta` are in use, in its order.
    episodes = None
    absolute_to_relative_idx = None

    @property
    def num_frames(self) -> int:
        """Number of items, by LeRobot's name."""
        return len(self)

    @property
    def num_episodes(self) -> int:
        """Number of query episodes, by LeRobot's name."""
        return len(self.episode_ids)

    @cached_property
    def meta(self) -> LeRobotMeta:
        """What LeRobot's training reads beside the items, with actions, in the layout `lerobot`.

        Raises:
            InvalidOptionError: Items have no actions.
        """
        if not self.chunk:
            raise InvalidOptionError.expected("chunk", 0, "1 or more: LeRobot trains on actions")
        live = self.buffer_set.datasets[EXECUTIONS]
        ends = self._moments.stops.tolist()
        return describe(
            self.buffer_set, live, self.episode_ids, ends, self.cameras, self.stored_values
        )

    @property
    def epoch(self) -> int:
        """The epoch, from 0."""
        return self._epoch.number

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, on which all draws depend, in this process and in those of its loaders.

        A `HistorySampler` does so by itself.
        """
        self._epoch.set(whole_number("epoch", epoch, "an integer from 0", 0))

    def values(self, name: str) -> NDArray[Any]:
        """Return a value of each item's moment, such as to weight or leave out moments by it.

        Args:
            name: `action`, the first of the chunk, `observation.state`, `frame_index` or
                `episode_id`.

        Returns:
            `(N, D) float32`, `(N,) int64` or `(N,)` texts.

        Raises:
            UnknownNameError: There is no such value; actions only if `chunk` is not 0.
        """
        numbers, moments = self._moments.of_items
        known = ["observation.state", "frame_index", "episode_id"]
        if self.chunk:
            known.append(ACTION)
        if name not in known:
            raise UnknownNameError.among("value", name, "the items", known)
        if name == "frame_index":
            return moments
        if name == "episode_id":
            return np.array([str(episode) for episode in self.episode_ids])[numbers]
        return self._rows.take(name, self._moments.first[numbers] + moments)

    def index_of(self, episode_id: EpisodeId | str, frame_index: int = 0) -> int:
        """Return the index of the item of an episode's moment.

        Raises:
            UnknownNameError: The episode is not in use, or does not have this moment.
        """
        return self._moments.index_of(EpisodeId.parse(episode_id), frame_index)

    def __getitem__(self, index: Any) -> dict[str, Any]:
        """Return an item, or for several indices a batch; see the class."""
        indices = np.asarray(range(len(self))[index] if isinstance(index, slice) else index)
        return self._batch(indices) if indices.ndim else item_of(self._batch(indices[None]), 0)

    def __getitems__(self, indices: Sequence[int]) -> Items:
        """Return the items of a batch, of which `default_collate` makes the batch at once.

        PyTorch's loaders call it.
        """
        self._epoch.count(len(indices))
        return Items(self._batch(np.asarray(indices)))

    def _batch(self, indices: NDArray[np.integer]) -> dict[str, Any]:
        """Return a batch, with all its entries."""
        if indices.ndim != 1 or indices.dtype.kind not in "iu" or not len(indices):
            given = f"indices of type {indices.dtype} and shape {indices.shape}"
            raise IndexError(f"{given}; expected one integer or several")
        epoch = self.epoch
        items = [self._draws.draw(epoch, index) for index in indices.tolist()]
        numbers = [drawn.number for drawn in items]
        episodes = [self.episode_ids[number] for number in numbers]
        arrays = self._batches.arrays(items)
        texts = {
            "task": [self.buffer_set.query(episode).goal for episode in episodes],
            "condition": [drawn.condition for drawn in items],
            "shift": [drawn.shift for drawn in items],
            "episode_id": [str(episode) for episode in episodes],
        }
        if self._questions is not None:
            arrays |= self._questions.arrays(numbers)
            texts |= self._questions.texts(numbers)
        batch = {name: torch.from_numpy(values) for name, values in arrays.items()} | texts
        if self._image_transforms is not None:
            keys = [(self.seed, epoch, drawn.item) for drawn in items]
            transform_images(batch, self.cameras, self._image_transforms, keys)
        return renamed(batch) if self.layout == "lerobot" else batch
