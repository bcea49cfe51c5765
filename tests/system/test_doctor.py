import io
import json
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest
from rich.console import Console

from robomme_interference_data import doctor
from robomme_interference_data.doctor import Check
from robomme_interference_data.vulkan import VulkanDevice, VulkanReport

OK = Check("fine", True, "1.0")
ABSENT = Check("optional", None, "not installed", 'pip install "robomme-interference-data[build]"')
BROKEN = Check("needed", False, "broken", "mend it")

Installed = Callable[[dict[str, tuple[str, list[str]]]], None]


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Installed:
    """Replace what is installed: name to version and requirements."""

    def replace(distributions: dict[str, tuple[str, list[str]]]) -> None:
        def look_up(name: str) -> tuple[str, list[str]]:
            if name not in distributions:
                raise metadata.PackageNotFoundError(name)
            return distributions[name]

        monkeypatch.setattr(metadata, "version", lambda name: look_up(name)[0])
        monkeypatch.setattr(metadata, "requires", lambda name: look_up(name)[1])

    return replace


@pytest.mark.parametrize(
    ("rows", "failed"),
    [([], False), ([OK, ABSENT], False), ([OK, BROKEN, ABSENT], True)],
)
def test_only_what_is_needed_can_fail(rows: list[Check], failed: bool) -> None:
    assert doctor.any_failed(rows) is failed


def test_the_table_shows_state_name_detail_and_the_whole_fix() -> None:
    out = io.StringIO()
    Console(file=out, width=100).print(doctor.render([OK, ABSENT, BROKEN]))
    lines = [line.rstrip() for line in out.getvalue().splitlines()]
    assert lines[1:] == [
        "ok      fine      1.0",
        "absent  optional  not installed",
        '                  to mend: pip install "robomme-interference-data[build]"',
        "FAILS   needed    broken",
        "                  to mend: mend it",
    ]


def test_json_holds_every_field() -> None:
    assert json.loads(doctor.to_json([OK, ABSENT])) == [
        {"name": "fine", "ok": True, "detail": "1.0", "fix": None},
        {
            "name": "optional",
            "ok": None,
            "detail": "not installed",
            "fix": 'pip install "robomme-interference-data[build]"',
        },
    ]


def test_this_environment_has_all_that_is_needed() -> None:
    rows = doctor.checks()
    assert [row.name for row in rows] == [
        "Python",
        "Core libraries",
        "Video (PyAV)",
        "Build datasets [build]",
        "FFmpeg's shared libraries",
        "OpenCV",
        "Simulator [sim]",
        "Vulkan",
        "Official simulator",
        "Evaluate [evaluate]",
        "Retrieval [retrieval]",
        "Score [score]",
        "Hub token",
        "Hub cache",
    ]
    assert [row for row in rows if row.ok is False] == []
    # What works needs no mending.
    assert [row.fix for row in rows if row.ok] == [None] * sum(row.ok is True for row in rows)


def test_no_heavy_library_is_imported() -> None:
    code = (
        "import sys; from robomme_interference_data.doctor import checks; checks();"
        "print(sorted({'torch', 'lerobot', 'h5py', 'sapien', 'mani_skill', 'transformers',"
        " 'matplotlib', 'datasets', 'pandas'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_an_old_python_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MIN_PYTHON", (9, 9))
    row = doctor._python()
    assert row.ok is False
    assert row.fix == "install Python 9.9 or later, then: pip install robomme-interference-data"


OURS = [
    "numpy>=2.0",
    'colorama; sys_platform == "win33"',
    'lerobot[dataset]<0.7,>=0.6.1; extra == "build"',
    'h5py>=3.10; extra == "build"',
]
LEROBOT = ['datasets<5,>=4.8; extra == "dataset"', 'pygame; extra == "teleop"']


@pytest.mark.parametrize(
    ("others", "core", "build"),
    [
        (
            {"numpy": "2.2.6", "lerobot": "0.6.1", "h5py": "3.16.0", "datasets": "4.8.5"},
            (True, "numpy 2.2.6"),
            (True, "lerobot 0.6.1, h5py 3.16.0"),
        ),
        (
            {"numpy": "1.26.4", "lerobot": "0.6.1", "datasets": "5.0.0"},
            (False, "numpy 1.26.4 is not >=2.0"),
            (None, "datasets 5.0.0 is not <5,>=4.8, h5py is not installed"),
        ),
        (
            {"lerobot": "0.5.0", "h5py": "3.16.0"},
            (False, "numpy is not installed"),
            (None, "lerobot 0.5.0 is not <0.7,>=0.6.1, datasets is not installed"),
        ),
    ],
)
def test_requirements_of_the_core_and_of_an_extra(
    installed: Installed,
    others: dict[str, str],
    core: tuple[bool, str],
    build: tuple[bool | None, str],
) -> None:
    requirements = {"robomme-interference-data": OURS, "lerobot": LEROBOT}
    versions = {"robomme-interference-data": "0.1.0", **others}
    installed({name: (text, requirements.get(name, [])) for name, text in versions.items()})

    row = doctor._core()
    assert (row.ok, row.detail) == core
    upgrade = "pip install --upgrade robomme-interference-data"
    assert row.fix == (None if core[0] else upgrade)

    row = doctor._extra("build")
    assert (row.ok, row.detail) == build
    assert row.fix == (None if build[0] else 'pip install "robomme-interference-data[build]"')


def test_a_package_that_is_not_installed_itself(installed: Installed) -> None:
    installed({})
    row = doctor._core()
    assert (row.ok, row.detail) == (False, "robomme-interference-data itself is not installed")
    assert doctor._extra("sim").ok is None


def test_every_extra_but_all_has_a_row() -> None:
    extras = metadata.metadata("robomme-interference-data").get_all("Provides-Extra")
    assert sorted(doctor._EXTRAS) == sorted(set(extras or ()) - {"all"})


def test_a_missing_codec_fails_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    codecs = (("libdav1d", "r"), ("libnothing", "w"), ("libdav1d", "w"))
    monkeypatch.setattr(doctor, "_CODECS", codecs)
    row = doctor._video()
    assert row.ok is False
    assert row.detail.endswith("has no encoder libnothing, encoder libdav1d")
    assert row.fix is not None


def test_absent_shared_ffmpeg_libraries_are_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_LIBAVUTIL_VERSIONS", (9999,))
    row = doctor._shared_ffmpeg()
    assert row.ok is None
    assert row.fix is not None
    assert row.fix.endswith("install ffmpeg")


@pytest.mark.parametrize(
    ("packages", "ok"),
    [
        ([], None),
        (["opencv-python-headless"], True),
        (["opencv-python"], True),
        (["opencv-python", "opencv-python-headless"], False),
    ],
)
def test_two_opencv_packages_fail(
    installed: Installed, packages: list[str], ok: bool | None
) -> None:
    installed({name: ("4.13.0", []) for name in packages})
    row = doctor._opencv()
    assert row.ok is ok
    assert (row.fix is not None) is (ok is False)


def test_the_vulkan_row(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = (
        VulkanDevice("old", software=False, usable=False),
        VulkanDevice("llvmpipe", software=True, usable=True),
        VulkanDevice("card", software=False, usable=True),
    )
    monkeypatch.setattr(doctor, "find_vulkan", lambda: VulkanReport(devices, None))
    assert doctor._vulkan() == Check("Vulkan", True, "llvmpipe, on the CPU; card")

    monkeypatch.setattr(doctor, "find_vulkan", lambda: VulkanReport((), "no driver"))
    row = doctor._vulkan()
    assert (row.ok, row.detail) == (None, "no driver; only simulators need it")
    assert row.fix is not None
    assert "make vulkan" in row.fix


def test_a_token_is_found_and_never_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._hub_token().ok is None
    monkeypatch.setattr("huggingface_hub.get_token", lambda: "hf_secret")
    row = doctor._hub_token()
    assert row.ok is True
    assert "hf_secret" not in repr(row)


def test_a_cache_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "new" / "hub"))
    assert doctor._hub_cache().ok is True

    (tmp_path / "file").touch()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "file" / "hub"))
    row = doctor._hub_cache()
    assert (row.ok, row.detail) == (None, f"{tmp_path / 'file' / 'hub'} cannot be written")
