"""Models in this process: a tiny one with random weights, saved and loaded like a real one."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.asking import ask
from support.lazy import lazy
from support.messages import raises

from robomme_interference_data.errors import InvalidOptionError, ModelError
from robomme_interference_data.evaluate.language.models import (
    MODELS,
    Message,
    Video,
    model_identity,
)
from robomme_interference_data.storage import weights

_, tiny_models = lazy("transformers"), lazy("support.vision_language")
loaded = lazy("robomme_interference_data.evaluate.language.transformers")

NOISE = np.random.default_rng(0).integers(0, 256, (6, 32, 24, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_models.save_tiny_model(tmp_path_factory.mktemp("models") / "tiny")


def asked(number: int) -> list[Message]:
    return [Message("system", ("be brief",)), Message("user", (NOISE[number], "what is it?"))]


def test_answers_are_deterministic_and_depend_on_the_image(tiny: Path) -> None:
    model = MODELS.make(f"transformers:{tiny}", ["max_tokens=12", "device=cpu"])
    first, again, other = (model.reply(asked(number)) for number in (0, 0, 1))
    assert first.text and first.text == again.text != other.text
    assert first.calls == 1 and first.seconds > 0
    # One image is four patches and the class; the words are single letters.
    words = "system: be brief user: what is it? assistant: "
    assert first.tokens is not None and len(words) + 5 < first.tokens <= len(words) + 5 + 12


def test_a_video_is_thinned_out(tiny: Path) -> None:
    model = MODELS.make(f"transformers:{tiny}", ["max_tokens=1", "images=3"])
    video = model.reply([Message("user", (Video(NOISE, 10.0),))])
    images = model.reply([Message("user", (NOISE[0], NOISE[2], NOISE[5]))])
    assert (video.text, video.tokens) == (images.text, images.tokens)


def test_an_adapter_is_another_model(tiny: Path, tmp_path: Path) -> None:
    adapter = tiny_models.save_tiny_adapter(tiny, tmp_path / "adapter")
    plain = MODELS.make(f"transformers:{tiny}", ["max_tokens=12"])
    adapted = MODELS.make(f"transformers:{tiny}", ["max_tokens=12", f"adapter={adapter}"])
    assert plain.reply(asked(0)).text != adapted.reply(asked(0)).text
    assert plain.metadata() == {"sha256": plain.metadata()["sha256"]}
    assert {*adapted.metadata()} == {"sha256", "adapter_sha256"}


def test_the_folder_is_not_part_of_the_identity(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "moved").symlink_to(tiny)
    other = tiny_models.save_tiny_model(tmp_path / "other", seed=1)
    said = [
        MODELS.make(f"transformers:{path}").metadata() for path in (tiny, tmp_path / "moved", other)
    ]
    assert said[0] == said[1] != said[2]
    hub = said[0] | {"model": "someone/tiny", "revision": "0" * 40}
    assert model_identity(f"transformers:{tiny}", ["device=cpu"], said[0]) == model_identity(
        "transformers:someone/tiny", ["adapter=elsewhere"], hub
    )


def test_the_identity_needs_no_loaded_weights_and_is_cached(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    metadata = MODELS.make(f"transformers:{tiny}").metadata()
    assert MODELS.pin(f"transformers:{tiny}") == f"transformers:{tiny}"
    monkeypatch.setattr(loaded.TransformersModel, "_load", None)
    monkeypatch.setattr(weights, "digest_folder", None)
    assert MODELS.make(f"transformers:{tiny}").metadata() == metadata


def test_digests_follow_the_files(tmp_path: Path) -> None:
    file = tmp_path / "model" / "model.safetensors"
    file.parent.mkdir()
    digests = set()
    for text, time in (("a", 1), ("b", 1), ("b", 2), ("bb", 2)):
        file.write_text(text)
        os.utime(file, (time, time))
        digests.add(weights.digest_weights(file.parent, ["*.safetensors"]))
        assert weights.digest_weights(file.parent, ["*.json"]) not in digests
    assert len(digests) == 3
    kept = [*(weights.cache_folder("weights")).iterdir()]
    for one in kept:
        one.write_text("damaged")
    assert weights.digest_weights(file.parent, ["*.safetensors"]) in digests


def test_models_that_cannot_be_loaded(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with raises(ModelError):
        MODELS.make(f"transformers:{tmp_path / 'empty'}")
    for file in tiny.glob("*.json"):
        shutil.copy(file, tmp_path / "empty")
    with raises(ModelError):
        MODELS.make(f"transformers:{tmp_path / 'empty'}")
    with raises(InvalidOptionError):
        MODELS.make("transformers:nowhere at all")
    with raises(InvalidOptionError):
        MODELS.make(f"transformers:{tiny}", ["device=cuda:77"])


def test_a_run_of_questions(tiny: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "model": f"transformers:{tiny}",
        "system": "tiny",
        "memory": "framesamp:2",
    }
    settings["families"] = ("MoveCube",)
    rows = ask(tmp_path / "run", **settings, model_options=("max_tokens=12",)).rows
    assert {row.status for row in rows} <= {"success", "fail"} and len(rows) == 2
    assert {row.model_calls for row in rows} == {1}
    (tmp_path / "moved").symlink_to(tiny)  # the same weights: the same run, which is done
    moved = settings | {"model": f"transformers:{tmp_path / 'moved'}"}
    assert ask(tmp_path / "run", **moved, model_options=("max_tokens=12",)).rows == rows
