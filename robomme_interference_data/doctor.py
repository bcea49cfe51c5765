"""Find out what works on this machine, and which command mends what does not.

Nothing heavy is imported: installed versions are read from the packages' metadata.
"""

import ctypes
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from rich.table import Table
from rich.text import Text

from robomme_interference_data.vulkan import find_vulkan

__all__ = ["Check", "any_failed", "checks", "render", "to_json"]

DISTRIBUTION = "robomme-interference-data"

MIN_PYTHON = (3, 12)

_CODECS = (("libaom-av1", "w"), ("libsvtav1", "w"), ("libdav1d", "r"))
"""Codecs that datasets are written and read with: FFmpeg's name, `w` encoder or `r` decoder."""

_LIBAVUTIL_VERSIONS = range(60, 55, -1)
"""Versions of libavutil in FFmpeg 8 to 4, which torchcodec can load."""

_ROBOMME_TIMEOUT_S = 120

_EXTRAS = {
    "build": "Build datasets",
    "sim": "Simulator",
    "evaluate": "Evaluate",
    "retrieval": "Retrieval",
    "score": "Score",
}


@dataclass(frozen=True)
class Check:
    """One row of the doctor's table.

    Attributes:
        name: What was looked at.
        ok: True if it works, False if something needed does not, None if something optional is
            absent or cannot be used.
        detail: Versions, names, or what is wrong.
        fix: The command that mends it; None if there is nothing to mend.
    """

    name: str
    ok: bool | None
    detail: str
    fix: str | None = None


def checks() -> list[Check]:
    """Look at everything; takes about a second."""
    return [
        _python(),
        _core(),
        _video(),
        _extra("build"),
        _shared_ffmpeg(),
        _opencv(),
        _extra("sim"),
        _vulkan(),
        _robomme(),
        _extra("evaluate"),
        _extra("retrieval"),
        _extra("score"),
        _hub_token(),
        _hub_cache(),
    ]


def any_failed(rows: Sequence[Check]) -> bool:
    """Tell whether something needed does not work; absent optional parts do not count."""
    return any(row.ok is False for row in rows)


def render(rows: Sequence[Check]) -> Table:
    """Return the rows as a table for a terminal."""
    words = {True: ("ok", "green"), False: ("FAILS", "bold red"), None: ("absent", "yellow")}
    table = Table(show_lines=False, pad_edge=False, box=None)
    for title in ("", "what", "found"):
        table.add_column(title, overflow="fold", no_wrap=title == "")
    for row in rows:
        # Text, not markup: a fix such as pip install "…[build]" holds brackets.
        found = Text(row.detail)
        if row.fix is not None:
            found.append(f"\nto mend: {row.fix}", style="cyan")
        table.add_row(Text(*words[row.ok]), Text(row.name), found)
    return table


def to_json(rows: Sequence[Check]) -> str:
    """Return the rows as a JSON list of objects with the fields of `Check`."""
    return json.dumps([asdict(row) for row in rows], indent=2, ensure_ascii=False)


def _python() -> Check:
    ok = sys.version_info >= MIN_PYTHON
    needed = ".".join(map(str, MIN_PYTHON))
    return Check(
        "Python",
        ok,
        f"{platform.python_version()} ({sys.executable})",
        None if ok else f"install Python {needed} or later, then: pip install {DISTRIBUTION}",
    )


def _core() -> Check:
    fix = f"pip install --upgrade {DISTRIBUTION}"
    try:
        ok, detail = _describe(_requirements(DISTRIBUTION, ""))
    except metadata.PackageNotFoundError:
        return Check("Core libraries", False, f"{DISTRIBUTION} itself is not installed", fix)
    return Check("Core libraries", ok, detail, None if ok else fix)


def _extra(extra: str) -> Check:
    try:
        ok, detail = _describe(_requirements(DISTRIBUTION, extra))
    except metadata.PackageNotFoundError:
        ok, detail = False, f"{DISTRIBUTION} itself is not installed"
    return Check(
        f"{_EXTRAS[extra]} [{extra}]",
        True if ok else None,
        detail,
        None if ok else f'pip install "{DISTRIBUTION}[{extra}]"',
    )


def _requirements(distribution: str, extra: str) -> list[Requirement]:
    """Return what a distribution needs here for one of its extras, or without any (`""`)."""

    def applies(requirement: Requirement, extra: str) -> bool:
        return requirement.marker is None or requirement.marker.evaluate({"extra": extra})

    requirements = [Requirement(line) for line in metadata.requires(distribution) or ()]
    return [
        requirement
        for requirement in requirements
        if applies(requirement, extra) and (extra == "" or not applies(requirement, ""))
    ]


def _describe(requirements: Sequence[Requirement]) -> tuple[bool, str]:
    """Return whether all requirements are met, and the installed versions or what is wrong."""
    problems = [problem for requirement in requirements for problem in _problems(requirement)]
    if problems:
        return False, ", ".join(problems)
    versions = (f"{item.name} {metadata.version(item.name)}" for item in requirements)
    return True, ", ".join(versions)


def _problems(requirement: Requirement) -> Iterator[str]:
    """Yield what is missing or of a wrong version, extras of the requirement included."""
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        yield f"{requirement.name} is not installed"
        return
    if not requirement.specifier.contains(version, prereleases=True):
        yield f"{requirement.name} {version} is not {requirement.specifier}"
    for extra in sorted(requirement.extras):
        for nested in _requirements(requirement.name, extra):
            yield from _problems(nested)


def _video() -> Check:
    name = "Video (PyAV)"
    fix = 'pip install --force-reinstall --only-binary av "av>=14"'
    try:
        import av
    except ImportError as error:
        return Check(name, False, str(error), fix)
    missing = []
    for codec, mode in _CODECS:
        try:
            av.codec.Codec(codec, mode)
        except ValueError:
            missing.append(f"{'encoder' if mode == 'w' else 'decoder'} {codec}")
    versions = f"FFmpeg {av.ffmpeg_version_info} in PyAV {av.__version__}"
    if missing:
        return Check(name, False, f"{versions} has no {', '.join(missing)}", fix)
    return Check(name, True, f"{versions} with {', '.join(codec for codec, _ in _CODECS)}")


def _shared_ffmpeg() -> Check:
    name = "FFmpeg's shared libraries"
    pattern = "libavutil.{}.dylib" if sys.platform == "darwin" else "libavutil.so.{}"
    for version in _LIBAVUTIL_VERSIONS:
        try:
            ctypes.CDLL(pattern.format(version))
        except OSError:
            continue
        return Check(name, True, f"{pattern.format(version)}, for torchcodec")
    install = "brew install ffmpeg" if sys.platform == "darwin" else "sudo apt-get install ffmpeg"
    return Check(name, None, "not found; only torchcodec needs them", install)


def _opencv() -> Check:
    installed = {}
    for package in ("opencv-python", "opencv-python-headless"):
        try:
            installed[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    found = ", ".join(f"{package} {version}" for package, version in installed.items())
    if len(installed) < 2:
        return Check("OpenCV", True if installed else None, found or "not installed")
    return Check(
        "OpenCV",
        False,
        f"{found} overwrite each other's files",
        "pip uninstall -y opencv-python opencv-python-headless && "
        'pip install "opencv-python-headless<4.14"',
    )


def _vulkan() -> Check:
    report = find_vulkan()
    if report.problem is None:
        usable = [device for device in report.devices if device.usable]
        names = [d.name + (", on the CPU" if d.software else "") for d in usable]
        return Check("Vulkan", True, "; ".join(names))
    return Check(
        "Vulkan",
        None,
        f"{report.problem}; only simulators need it",
        "sudo make vulkan (in a checkout, on Debian), or install your GPU's Vulkan driver",
    )


def _robomme() -> Check:
    name = "Official simulator"
    fix = "export ROBOMME_PYTHON=PATH, the Python of an environment that RoboMME is installed in"
    python = os.environ.get("ROBOMME_PYTHON")
    if not python:
        return Check(
            name, None, "ROBOMME_PYTHON is not set; only --simulator robomme needs it", fix
        )
    try:
        done = subprocess.run(
            [python, Path(__file__).parent / "simulators" / "robomme_worker.py"],
            env={**os.environ, "PYTHONSAFEPATH": "1"},
            capture_output=True,
            text=True,
            timeout=_ROBOMME_TIMEOUT_S,
            check=True,
        )
        found = json.loads(done.stdout.splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError) as error:
        return Check(name, False, f"{python} cannot be asked: {error}", fix)
    if "problem" in found:
        return Check(name, False, f"{python}: {found['problem']}", fix)
    versions = f"Python {found['python']}, numpy {found['numpy']}"
    return Check(name, True, f"{python}: {versions}, {len(found['families'])} families")


def _hub_token() -> Check:
    from huggingface_hub import get_token

    if get_token():
        return Check("Hub token", True, "found")
    return Check("Hub token", None, "none; only private datasets need it", "hf auth login")


def _hub_cache() -> Check:
    from huggingface_hub import constants

    cache = Path(constants.HF_HUB_CACHE)
    existing = next(folder for folder in (cache, *cache.parents) if folder.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        fix = "export HF_HOME=FOLDER, a folder that you may write to"
        return Check("Hub cache", None, f"{cache} cannot be written", fix)
    free = shutil.disk_usage(existing).free / 1e9
    return Check("Hub cache", True, f"{cache}, {free:.0f} GB free")
