import re
import subprocess
import sys
from importlib import util
from pathlib import Path

import pytest

from robomme_interference_data import vulkan
from robomme_interference_data.vulkan import VulkanDevice, VulkanReport, find_vulkan


@pytest.mark.parametrize(
    ("probe", "report"),
    [
        (
            'print(\'{"devices": [{"name": "a", "software": true, "usable": true}], '
            '"problem": null}\')',
            VulkanReport((VulkanDevice("a", software=True, usable=True),), None),
        ),
        (
            'print(\'{"devices": [], "problem": "none"}\'); raise SystemExit(1)',
            VulkanReport((), "none"),
        ),
        (
            "import os; os.abort()",
            VulkanReport((), "a Vulkan driver crashed (exit status -6)"),
        ),
        (
            "import time; time.sleep(60)",
            VulkanReport((), "a Vulkan driver did not answer within 1 s"),
        ),
    ],
    ids=["found", "none", "crash", "hang"],
)
def test_the_search_survives_any_driver(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, probe: str, report: VulkanReport
) -> None:
    (tmp_path / "probe.py").write_text(probe, encoding="utf-8")
    monkeypatch.setattr(vulkan, "__file__", str(tmp_path / "probe.py"))
    monkeypatch.setattr(vulkan, "_TIMEOUT_S", 1 if "sleep" in probe else 60)
    assert find_vulkan() == report


@pytest.mark.skipif(util.find_spec("sapien") is None, reason="sapien is not installed")
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the search is for Linux")
def test_the_search_agrees_with_the_simulator() -> None:
    code = "import sapien; print(sapien.render.get_device_summary())"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60
    )
    # Without a device to render on, the simulator fails and lists none.
    usable = re.findall(r"GPU: (.+)\n  Supported: 1\n", done.stdout)
    report = find_vulkan()
    assert [device.name for device in report.devices if device.usable] == usable
    assert (report.problem is None) is bool(usable)
