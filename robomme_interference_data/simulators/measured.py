"""The columns of rows that compare actions with recorded ones."""

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True, kw_only=True)
class ActionErrorColumns:
    """The difference of a policy's actions to those of a recording; all None in a simulator."""

    action_l1: Annotated[
        float | None,
        "Offline: mean absolute difference of the actions to the recorded ones, over all steps and "
        "values, in the actions' units.",
    ] = None
    action_l1_values: Annotated[
        str | None, "The same for each value of the action, in their order, separated by spaces."
    ] = None
