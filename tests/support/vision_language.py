"""A tiny vision-language model with random weights, made on the spot."""

from pathlib import Path

import torch
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import (
    CLIPImageProcessor,
    CLIPVisionConfig,
    LlamaConfig,
    LlavaConfig,
    LlavaForConditionalGeneration,
    LlavaProcessor,
    PreTrainedTokenizerFast,
)

_TEMPLATE = (
    "{% for message in messages %}{{ message.role }}: {% for part in message.content %}"
    "{% if part.type == 'image' %}<image>{% else %}{{ part.text }}{% endif %}{% endfor %} "
    "{% endfor %}assistant: "
)


def save_tiny_model(folder: Path, seed: int = 0) -> Path:
    """Save a LLaVA of two layers, with its processor; words are single bytes."""
    words = {chr(letter): letter for letter in range(32, 127)}
    names = ["<unk>", "<s>", "</s>", "<image>", *words]
    vocabulary = {name: number for number, name in enumerate(names)}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Split("", "isolated")
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        unk_token="<unk>",
        bos_token="<s>",
        eos_token="</s>",
        pad_token="</s>",
        additional_special_tokens=["<image>"],
    )
    side = {"height": 16, "width": 16}
    processor = LlavaProcessor(
        image_processor=CLIPImageProcessor(size=side, crop_size=side),
        tokenizer=fast,
        patch_size=8,
        vision_feature_select_strategy="full",
        image_token="<image>",
        chat_template=_TEMPLATE,
        num_additional_image_tokens=1,
    )
    torch.manual_seed(seed)
    shape = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2}
    shape |= {"num_attention_heads": 2}
    model = LlavaForConditionalGeneration(
        LlavaConfig(
            vision_config=CLIPVisionConfig(image_size=16, patch_size=8, **shape),
            text_config=LlamaConfig(
                vocab_size=len(names), num_key_value_heads=2, initializer_range=1.0, **shape
            ),
            image_token_index=vocabulary["<image>"],
            vision_feature_select_strategy="full",
            vision_feature_layer=-1,
        )
    )
    model.generation_config.eos_token_id = vocabulary["</s>"]
    model.generation_config.pad_token_id = vocabulary["</s>"]
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


def save_tiny_adapter(model: Path, folder: Path) -> Path:
    """Save a LoRA adapter with random weights for such a model."""
    from peft import LoraConfig, get_peft_model

    torch.manual_seed(1)
    base = LlavaForConditionalGeneration.from_pretrained(model)
    config = LoraConfig(target_modules=["q_proj", "v_proj"], init_lora_weights=False, r=4)
    get_peft_model(base, config).save_pretrained(folder)
    return folder
