"""SmolVLA with a memory, whose frames are further images before the current ones.

`save_vision_language` writes the smallest model of SmolVLA's own classes, and a tokenizer.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors

MEMORY = "observation.memory."


@PreTrainedConfig.register_subclass("smolvla_memory")
@dataclass
class SmolVLAMemoryConfig(SmolVLAConfig):
    memory: str = "framesamp:32"
    image_size: int | None = 256

    @property
    def image_features(self) -> Any:
        """The current images, which SmolVLA reads by itself."""
        images = super().image_features
        return {name: image for name, image in images.items() if not name.startswith(MEMORY)}


class SmolVLAMemoryPolicy(SmolVLAPolicy):
    config_class = SmolVLAMemoryConfig
    name = "smolvla_memory"

    def prepare_images(self, batch: dict[str, Any]) -> tuple[list[Any], list[Any]]:
        """Return the images in memory, oldest first, and the current ones, with their masks."""
        names, images, masks = list(self.config.image_features), [], []
        seen = {name: batch[MEMORY + name.removeprefix("observation.")] for name in names}
        there = ~batch[MEMORY + "padding"]
        for place in range(there.shape[1]):
            then = {name: frames[:, place] for name, frames in seen.items()}
            then |= {f"{name}_padding_mask": there[:, place] for name in names}
            found = super().prepare_images(then)
            images += found[0]
            masks += found[1]
        found = super().prepare_images(batch)
        return [*images, *found[0]], [*masks, *found[1]]


make_smolvla_memory_pre_post_processors = make_smolvla_pre_post_processors


def save_vision_language(folder: Path) -> Path:
    """Save configuration, processor and tokenizer of a vision-language model without weights."""
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace
    from transformers import PreTrainedTokenizerFast, SmolVLMConfig

    image, special = "<image>", ("<pad>", "<unk>", "<fake_token_around_image>", "<global-img>")
    words = {word: number for number, word in enumerate((*special, image, "<end_of_utterance>"))}
    words |= {f"word{number}": len(words) + number for number in range(20)}
    tokenizer = Tokenizer(WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = Whitespace()
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token="<pad>",
        unk_token="<unk>",
        extra_special_tokens={
            "fake_image_token": "<fake_token_around_image>",
            "global_image_token": "<global-img>",
            "image_token": image,
        },
    ).save_pretrained(folder)
    layers = {"hidden_size": 32, "num_hidden_layers": 2, "intermediate_size": 32}
    text = {"model_type": "llama", "vocab_size": len(words), "pad_token_id": 0, "head_dim": 16}
    heads = {"num_attention_heads": 2, "num_key_value_heads": 1}
    SmolVLMConfig(
        text_config=text | layers | heads,
        vision_config=layers | {"num_attention_heads": 2, "image_size": 32, "patch_size": 8},
        scale_factor=2,
        image_token_id=words[image],
        pad_token_id=0,
    ).save_pretrained(folder)
    # The processor of an equal model: SmolVLM's own needs a package that spells numbers.
    parts = {"image_processor_type": "Idefics3ImageProcessor"}
    (folder / "preprocessor_config.json").write_text(json.dumps(parts))
    whole = {"processor_class": "Idefics3Processor", "image_seq_len": 4}
    (folder / "processor_config.json").write_text(json.dumps(whole))
    return folder
