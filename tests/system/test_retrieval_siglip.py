"""SigLIP through transformers: small models of random weights, saved and loaded by path."""

import json
import pickle
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import QUERIES
from support.messages import raises
from support.retrieval import make_index

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.data.embeddings import normalized, open_index
from robomme_interference_data.errors import FormatError, HubError, InvalidOptionError
from robomme_interference_data.retrieval.encoders import make_encoder
from robomme_interference_data.retrieval.measure import measure
from robomme_interference_data.retrieval.selector import Selector


@cache
def siglip(folder: Path) -> str:
    """Save a small SigLIP of random weights; returns the encoder's name."""
    torch = pytest.importorskip("torch")
    transformers = pytest.importorskip("transformers")
    tower = {"hidden_size": 32, "intermediate_size": 64, "num_attention_heads": 2}
    config = transformers.SiglipConfig(
        vision_config=tower | {"num_hidden_layers": 2, "image_size": 32, "patch_size": 8},
        text_config=tower | {"num_hidden_layers": 1, "vocab_size": 64, "projection_size": 32},
    )
    torch.manual_seed(0)
    transformers.SiglipModel(config).save_pretrained(folder)
    settings = {"image_processor_type": "SiglipImageProcessor", "size": {"height": 32, "width": 32}}
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return f"siglip:{folder}"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    return siglip(tmp_path_factory.mktemp("models") / "tiny")


def test_siglip_is_transformers_own_pipeline(model: str) -> None:
    import torch
    import transformers
    from transformers import AutoImageProcessor, SiglipModel

    folder = model.partition(":")[2]
    images = np.random.default_rng(0).integers(0, 256, (9, 48, 64, 3), np.uint8)
    encoder = make_encoder(model, device="cpu")
    found = encoder.features(encoder.prepare(images))
    whole = SiglipModel.from_pretrained(folder).eval()
    processor = AutoImageProcessor.from_pretrained(folder, backend="pil")
    with torch.no_grad():
        inputs = processor(images=list(images), return_tensors="pt")
        expected = whole.get_image_features(**inputs).pooler_output.numpy()
    assert found.shape == (9, 32) and found.dtype == np.float32
    assert found == pytest.approx(expected, abs=1e-5)
    # Alone or together, within a unit of float16 (2⁻¹¹ of a value).
    alone = np.concatenate([encoder.features(encoder.prepare(image[None])) for image in images])
    apart = normalized(found) - normalized(alone)
    assert np.abs(apart).max() <= 2**-11
    assert encoder.computed_in == "cpu, float32"
    assert encoder.fingerprint == make_encoder(model, device="cpu").fingerprint
    assert encoder.fingerprint["preprocessing"]["size"] == {"height": 32, "width": 32}
    assert encoder.fingerprint["preprocessing"]["class"] == "SiglipImageProcessorPil"
    assert encoder.fingerprint["transformers"] == transformers.__version__


@pytest.mark.slow
def test_siglip_makes_an_index(own_buffers: Path, model: str) -> None:
    encoder = make_encoder(model, device="cpu")
    make_index(own_buffers, encoder)
    datasets = load_buffer_set(own_buffers).datasets
    demonstrations, length = datasets["demonstrations"], datasets["demonstrations"].record(0).length
    images = np.empty((length, *demonstrations.shape("front")), np.uint8)
    demonstrations.read_frames(0, "front", 0, images)
    found, expected = open_index(demonstrations, model).span(0, 0, length), encoder.prepare(images)
    assert found == pytest.approx(encoder.features(expected), rel=2e-3, abs=2e-3)
    assert open_index(datasets["distractors"], model).center is None
    buffer = load_buffer(QUERIES[0], "k1", buffer_set=own_buffers)
    selector = Selector(model, device="cpu")
    assert selector.label(buffer.query.dataset) == "siglip-tiny/max/adaptive"
    live = encoder.features(encoder.prepare(buffer.query.frame()[None]))
    given = measure(buffer, model, query=normalized(live)[0])
    assert given.alike == pytest.approx(measure(buffer, model).alike, abs=2e-3)
    chosen = selector.select(buffer, buffer.query.frame())
    assert 0 <= chosen[0] <= chosen[-1] < len(buffer)


def embed(folder: Path) -> np.ndarray:
    encoder = make_encoder(f"siglip:{folder}", device="cpu")
    return encoder.features(encoder.prepare(np.zeros((1, 32, 32, 3), np.uint8)))


def test_the_identity_needs_no_model(
    model: str, own_buffers: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from transformers import SiglipVisionModel

    make_index(own_buffers, make_encoder(model, device="cpu"))
    buffer = load_buffer(QUERIES[0], "k1", buffer_set=own_buffers)
    monkeypatch.setattr(SiglipVisionModel, "from_pretrained", lambda *_, **__: pytest.fail("loads"))
    identity = Selector(model, device="cpu").identity(buffer)
    assert identity["fingerprint"] == buffer.index(model).units.header.encoder.sha256


def test_a_worker_process_loads_the_model_itself(model: str) -> None:
    encoder = make_encoder(model, device="cpu", batch=3)
    packed = pickle.dumps(encoder)
    assert len(packed) < 1000
    again = pickle.loads(packed)
    assert (again.name, again.batch, again.fingerprint) == (encoder.name, 3, encoder.fingerprint)


def test_other_weights_or_settings_are_another_encoder(model: str, tmp_path: Path) -> None:
    import torch
    from transformers import SiglipVisionModel

    folder = Path(model.partition(":")[2])
    image = np.random.default_rng(0).integers(0, 256, (1, 32, 32, 3), np.uint8)

    def changed(path: Path) -> set[str]:
        """The keys of the fingerprint that differ, for models with different features."""
        one, other = (make_encoder(f"siglip:{place}", device="cpu") for place in (folder, path))
        rows = [encoder.features(encoder.prepare(image)) for encoder in (one, other)]
        assert not np.array_equal(*rows)
        return {key for key in one.fingerprint if one.fingerprint[key] != other.fingerprint[key]}

    weights = shutil.copytree(folder, tmp_path / "weights")
    vision = SiglipVisionModel.from_pretrained(weights)
    with torch.no_grad():
        next(vision.parameters()).add_(0.01)
    vision.save_pretrained(weights)
    assert changed(weights) == {"weights_sha256"}
    path = shutil.copytree(folder, tmp_path / "settings")
    config = json.loads((path / "config.json").read_text())
    config["vision_config"]["hidden_act"] = "relu"
    (path / "config.json").write_text(json.dumps(config))
    assert changed(path) == {"tower"}


def test_incomplete_model_is_an_error(model: str, tmp_path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    folder = shutil.copytree(model.partition(":")[2], tmp_path / "part")
    path = folder / "model.safetensors"
    tensors = load_file(path)
    # Of the second layer: two norms, four projections and two of the MLP, weight and bias each.
    part = {
        name: value for name, value in tensors.items() if "vision_model.encoder.layers.1" in name
    }
    assert len(part) == 16
    kept = {name: value for name, value in tensors.items() if name not in part}
    save_file(kept, path, metadata={"format": "pt"})
    with raises(FormatError) as caught:
        embed(folder)
    assert "download or save it again" in str(caught.value.hint)
    path.write_bytes(path.read_bytes()[:1000])
    with raises(FormatError):
        embed(folder)


def test_missing_weights(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    with raises(HubError) as caught:
        make_encoder("siglip")
    assert "HF_HUB_OFFLINE" in str(caught.value.hint)
    with raises(InvalidOptionError):
        make_encoder("siglip:nothing")
    with raises(FormatError):
        make_encoder(f"siglip:{tmp_path}")
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    with raises(FormatError):
        make_encoder(f"siglip:{tmp_path}")


def test_unknown_device(model: str) -> None:
    with raises(InvalidOptionError):
        make_encoder(model, device="nowhere")
