"""Which device SAPIEN draws on, and its driver."""

import re
from typing import Any

import pytest

from robomme_interference_data.schema.renderers import renderers_note
from robomme_interference_data.simulators import sapien_renderer
from robomme_interference_data.simulators.registry import simulator_renderer
from robomme_interference_data.simulators.sapien_renderer import describe_renderer, renderer_in

CPU, DISCRETE, INTEGRATED = 4, 2, 1  # of Vulkan
DRIVERS = {
    "llvmpipe": (CPU, "llvmpipe Mesa 25.0.7"),
    "Intel Arc": (INTEGRATED, "Intel Mesa 25.0.7"),
    "Radeon": (DISCRETE, "radv Mesa 25.0.7"),
    "NVIDIA H200": (DISCRETE, "NVIDIA 570.86"),
}


def summary(*devices: tuple[str, int, int]) -> str:
    """What SAPIEN prints of devices: name, whether it can draw, CUDA id or -1."""
    return "".join(
        f"GPU: {name}\n  Supported: {supported}\n  Present:   0\n  cudaId:    {cuda}\n"
        "  rayTrace:  1\n  cudaMode   -1\n"
        for name, supported, cuda in devices
    )


@pytest.mark.parametrize(
    ("devices", "renderer"),
    [
        ([("llvmpipe", 1, -1)], "llvmpipe, driver llvmpipe Mesa 25.0.7, CPU AuthenticAMD"),
        ([("llvmpipe", 1, -1), ("NVIDIA H200", 1, 0)], "NVIDIA H200, driver NVIDIA 570.86, GPU"),
        # One without graphics, as in a container that was started without them.
        ([("NVIDIA H200", 0, 0), ("Radeon", 1, -1)], "Radeon, driver radv Mesa 25.0.7, GPU"),
        # A discrete device before an integrated one, and that one if it is the only GPU.
        ([("Intel Arc", 1, -1), ("Radeon", 1, -1)], "Radeon, driver radv Mesa 25.0.7, GPU"),
        ([("Intel Arc", 1, -1)], "Intel Arc, driver Intel Mesa 25.0.7, GPU"),
        # Vulkan's own library may be missing.
        ([("Voodoo", 1, -1)], "Voodoo"),
    ],
)
def test_the_device_that_draws(
    devices: list[Any], renderer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sapien

    monkeypatch.setattr(sapien.render, "get_device_summary", lambda: summary(*devices))
    monkeypatch.setattr(sapien_renderer, "vulkan_devices", lambda: DRIVERS)
    monkeypatch.setattr(sapien_renderer, "_processor", lambda: "AuthenticAMD")
    assert describe_renderer() == renderer


def test_the_renderer_of_this_machine(tabletop: Any) -> None:
    found = simulator_renderer("tabletop")
    assert found is not None and ", driver " in found
    kind = found.rpartition(", ")[2]
    assert kind == "GPU" or re.fullmatch(r"CPU \w+", kind)
    assert ("llvmpipe" in found) <= kind.startswith("CPU")
    assert simulator_renderer("support.worlds:World") is None  # which declares none


def test_an_interpreter_that_cannot_draw(tmp_path: Any) -> None:
    assert renderer_in(str(tmp_path / "no-python")) is None
    assert renderer_in("false") is None


def test_a_note_on_images_from_different_renderers() -> None:
    lessons, units, live = "demonstrations", "distractors", "live observations"
    assert renderers_note([]) is None
    assert renderers_note([(lessons, None), (units, "A"), (live, "A")]) is None
    assert renderers_note([(lessons, None), (units, None), (live, "A")]) is None
    note = renderers_note([(lessons, None), (units, "A"), (live, "B"), (live, "A"), (live, None)])
    assert note is not None
    known = "distractors and live observations from A; live observations from B; "
    known += "demonstrations unknown."
    assert known in note
