"""The processors of `history_act`: LeRobot's usual ones, after the views are resized."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.processor.factory import (
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor

from robomme_interference_data.training import resize

from .configuration_history_act import HistoryACTConfig


@dataclass
@ProcessorStepRegistry.register("history_act_resize")
class ResizeViews(ObservationProcessorStep):
    """Resizes current views, if they have another size, as `HistoryDataset` does.

    Attributes:
        size: Side in pixels; None for no change.
    """

    size: int | None = None

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with images `(B, 3, size, size)`, from 0 to 1."""
        for name, images in observation.items():
            if name.startswith(OBS_IMAGES + ".") and self.size not in (None, images.shape[-1]):
                observation[name] = self._resized(images)
        return observation

    def _resized(self, images: Tensor) -> Tensor:
        pixels = (images * 255).round().to(torch.uint8).permute(0, 2, 3, 1)
        small = torch.from_numpy(resize(pixels.cpu().numpy(), self.size))
        return small.to(images.device, images.dtype) / 255

    def get_config(self) -> dict[str, Any]:
        """Return what is saved."""
        return {"size": self.size}

    def transform_features(self, features: Any) -> Any:
        """Return the features, which are declared in the new size."""
        return features


def make_history_act_pre_post_processors(
    config: HistoryACTConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[Any, Any]:
    """Return preprocessor and postprocessor.

    Statistics of frames in memory must be those of current ones, as `HistoryDataset.meta` has them:
    then a frame that the policy keeps by itself has the same values as one that it is given.
    """
    steps = make_default_policy_processor_steps(
        config, dataset_stats, normalizer_device=config.device
    )
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            ResizeViews(config.image_size),
            steps.to_device,
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
