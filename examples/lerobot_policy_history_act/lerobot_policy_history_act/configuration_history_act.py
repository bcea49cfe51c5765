"""The configuration of `history_act`."""

from dataclasses import dataclass

from lerobot.configs import PolicyFeature, PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.utils.constants import OBS_STATE

from robomme_interference_data.schema.memory_features import MEMORY_PREFIX, in_memory


@PreTrainedConfig.register_subclass("history_act")
@dataclass
class HistoryACTConfig(ACTConfig):
    """ACT's configuration with a memory, and defaults for training from scratch.

    Attributes:
        memory: Rule by which frames are kept, see `robomme_interference_data.training.Memory`.
        image_size: Side of all images in pixels, current and remembered; None for no change.
    """

    memory: str = "framesamp:32"
    image_size: int | None = 96
    chunk_size: int = 16
    n_action_steps: int = 16
    pretrained_backbone_weights: str | None = None
    optimizer_lr: float = 1e-4
    optimizer_lr_backbone: float = 1e-4

    @property
    def image_features(self) -> dict[str, PolicyFeature]:
        """The current views, which ACT reads: those in memory have encoders of their own."""
        views = super().image_features
        return {name: view for name, view in views.items() if not name.startswith(MEMORY_PREFIX)}

    @property
    def remembered(self) -> tuple[str, ...]:
        """Names of the features of which the memory has earlier values."""
        return (*self.image_features, OBS_STATE)

    def validate_features(self) -> None:
        """Check that a dataset with a memory gave the features."""
        super().validate_features()
        names = [name for feature in self.remembered for name in (feature, in_memory(feature))]
        if missing := [name for name in names if name not in self.input_features]:
            raise ValueError(
                f"history_act also needs {', '.join(missing)}. "
                "Train it on history buffers: robomme-interference train"
            )
