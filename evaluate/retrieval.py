"""The retrieval step of a run: made of its settings, and checked before it starts."""

from typing import Any

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.systems import System
from robomme_interference_data.loader import Split
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.retrieval.selector import Selector

__all__ = ["check_retrieval", "make_selector", "retrieval_identity"]


def make_selector(config: RunConfig) -> Selector | None:
    """Make the retrieval step of a run, None if it has none.

    Raises:
        UnknownNameError, InvalidOptionError, MissingExtraError, MissingWeightsError, FormatError:
            See `Selector`.
    """
    if config.retrieval is None:
        return None
    return Selector(config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera)


def retrieval_identity(config: RunConfig, split: Split) -> dict[str, Any] | None:
    """Return what the choices of the retrieval step depend on, None without it.

    Raises:
        MissingIndexError, StaleIndexError, FormatError: The split has no fitting index.
    """
    selector = make_selector(config)
    if selector is None:
        return None
    return selector.identity(split.load(split.episode_ids[0], split.k_values[0]))


def check_retrieval(config: RunConfig, system: System) -> None:
    """Check that a system which stands in the table has the retrieval step that it says.

    Raises:
        InvalidOptionError: It has one and the run has none, or the other way round, or another.
    """
    if config.retrieval is None and system.retrieval:
        raise InvalidOptionError(
            f"system {system.name} has a retrieval step, and none is given",
            "Add --retrieval ENCODER, such as --retrieval siglip.",
        )
    if config.retrieval is not None and system.paper and not system.retrieval:
        raise InvalidOptionError(
            f"system {system.name} has no retrieval step, and --retrieval puts one in front",
            "Leave out one of the two, or give a --system of your own.",
        )
    if system.paper and system.retrieval and Rule.parse(config.retrieval_rule).method != "max":
        raise InvalidOptionError(
            f"the retrieval step of {system.name} chooses by max, not by {config.retrieval_rule}",
            "Leave out --retrieval-rule, or give a --system of your own.",
        )
