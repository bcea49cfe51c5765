"""What only some runs use; each name is imported on its first use.

A run without subgoals, for example, imports nothing of models. Code for all runs takes the parts of
an optional feature from here.
"""

from typing import TYPE_CHECKING

from robomme_interference_data.lazy import lazy_exports

if TYPE_CHECKING:
    from .language.images import HistoryFrames
    from .language.subgoal_settings import (
        describe_subgoals,
        make_writer,
        pin_subgoals,
        subgoals_identity,
        subgoals_text,
        with_published,
    )
    from .policies.answers import read_answers
    from .policies.process import policy_processes
    from .policies.server_lock import lock_server
    from .policies.shared import SharedPolicy
    from .rollout.clips import Clip
    from .run.tracking import Tracking, check_tracker, open_tracker

__all__ = [
    # videos
    "Clip",
    # answers
    "read_answers",
    # policy servers
    "lock_server",
    # shared policies
    "SharedPolicy",
    "policy_processes",
    # subgoals
    "HistoryFrames",
    "describe_subgoals",
    "make_writer",
    "pin_subgoals",
    "subgoals_identity",
    "subgoals_text",
    "with_published",
    # tracking
    "Tracking",
    "check_tracker",
    "open_tracker",
]

__getattr__ = lazy_exports(
    __name__,
    {
        f"{__package__}.language.images": "HistoryFrames",
        f"{__package__}.language.subgoal_settings": (
            "describe_subgoals make_writer pin_subgoals subgoals_identity subgoals_text "
            "with_published"
        ),
        f"{__package__}.policies.answers": "read_answers",
        f"{__package__}.policies.process": "policy_processes",
        f"{__package__}.policies.server_lock": "lock_server",
        f"{__package__}.policies.shared": "SharedPolicy",
        f"{__package__}.rollout.clips": "Clip",
        f"{__package__}.run.tracking": "Tracking check_tracker open_tracker",
    },
)
