"""Publish a split: its demonstrations, and then itself, which names their commit."""

from collections.abc import Iterable
from functools import cached_property

from robomme_interference_data.cards.goods import demonstrations_of, units_of
from robomme_interference_data.cards.publish_config import PublishConfig
from robomme_interference_data.cards.publisher import Publisher
from robomme_interference_data.cards.step import Step
from robomme_interference_data.constants import DEMONSTRATIONS
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import PublishError
from robomme_interference_data.hub import HubFiles
from robomme_interference_data.split import Split

_UNKNOWN = "0" * 40
"""Stands for the commit of demonstrations that are not published yet."""


class SplitPublisher:
    """Publishes a split whose checks have passed.

    Args:
        split: The split.
        config: As what.
        publisher: Makes the versions.
    """

    def __init__(self, split: Split, config: PublishConfig, publisher: Publisher):
        self.split = split
        self.config = config
        self.publisher = publisher

    @cached_property
    def base(self) -> str | None:
        """The published demonstrations that the split is for, `namespace/name@commit`, or None.

        Raises:
            HubError: They are not there.
            PublishError: They are others.
        """
        recorded = self.split.header.datasets[DEMONSTRATIONS]
        place, wanted = recorded.place or "", self.config.demonstrations_id
        if "@" not in place or wanted not in (None, place.split("@")[0]):
            return None
        if Dataset(HubFiles(*place.split("@"))).revision != recorded.revision:
            where = self.split.location
            raise PublishError(
                f"{place} holds other demonstrations than those that {where} is for",
                f"Plan the buffers again: robomme-interference build manifests {where}",
            )
        return place

    def plan(self) -> list[Step]:
        """Look at what is there; return what is to be done: the demonstrations, then the split.

        Raises:
            PublishError, HubError, InterferenceError: See `base` and `Publisher.step`.
        """
        if self.base is not None:
            return [self._own_step(self.base)]
        lessons = self.publisher.step(demonstrations_of(self.split, self.config), follows=True)
        return [lessons, self._own_step(_place(lessons))]

    def run(self, steps: Iterable[Step]) -> list[Step]:
        """Do what was planned; return the steps with their commits.

        Raises:
            HubError: See `Publisher.put`.
        """
        *lessons, own = steps
        done = [self.publisher.put(step) for step in lessons]
        if done != lessons:
            own = self._own_step(_place(done[0]))  # now that the commit is known
        return [*done, self.publisher.put(own)]

    def _own_step(self, base: str) -> Step:
        return self.publisher.step(units_of(self.split, self.config, base))


def _place(step: Step) -> str:
    return f"{step.repository.repo_id}@{step.published or _UNKNOWN}"
