"""ACT with a memory, for LeRobot: the import registers its configuration and processor steps."""

from .configuration_history_act import HistoryACTConfig
from .processor_history_act import ResizeViews, make_history_act_pre_post_processors

__all__ = ["HistoryACTConfig", "ResizeViews", "make_history_act_pre_post_processors"]
