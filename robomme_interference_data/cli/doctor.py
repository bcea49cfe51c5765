"""Find out what works on this machine, and which command mends what does not.

Nothing heavy is imported: installed versions are read from the packages' metadata, and other
processes are asked whether the simulators work.
"""

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path

from packaging.requirements import Requirement

from robomme_interference_data.errors import InterferenceError, first_line
from robomme_interference_data.viz.tables import Column, Table

DISTRIBUTION = "robomme-interference-data"

CODECS = (("libaom-av1", "w"), ("libsvtav1", "w"), ("libdav1d", "r"))
"""Codecs that datasets are written and read with: FFmpeg's name, `w` encoder or `r` decoder."""

LIBAVUTIL = range(60, 55, -1)
"""Versions of libavutil in FFmpeg 8 to 4, which torchcodec can load."""

RENDERER = "robomme_interference_data.simulators.tabletop.renderer"
"""The program that draws a picture: a broken driver can crash its process or never return."""

RENDERER_S, ROBOMME_S = 30, 120
"""Seconds that the simulators have to answer."""


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
    """Look at everything; takes a few seconds, and a minute more where RoboMME is."""
    return [
        Check("Python", True, f"{platform.python_version()} ({sys.executable})"),
        check_packages("Core libraries"),
        check_video(CODECS),
        check_packages("Build datasets", "build"),
        check_shared_ffmpeg(LIBAVUTIL),
        check_opencv(),
        check_packages("Simulator", "sim"),
        check_renderer(),
        check_robomme(),
        check_packages("Evaluate", "evaluate"),
        check_packages("Vision-language models", "vlm"),
        check_packages("Clusters", "cluster"),
        check_packages("Retrieval", "retrieval"),
        check_packages("Score", "score"),
        check_hub_token(),
        check_hub_cache(),
    ]


def any_failed(rows: Sequence[Check]) -> bool:
    """Tell whether something needed does not work; absent optional parts do not count."""
    return any(row.ok is False for row in rows)


def report(rows: Sequence[Check]) -> Table:
    """Return the rows as a table for a terminal; what mends one stands below it."""
    words = {True: "ok", False: "FAILS", None: "absent"}
    lines: list[tuple[str, str, str]] = []
    for row in rows:
        lines.append((words[row.ok], row.name, row.detail))
        if row.fix is not None:
            lines.append(("", "", f"to mend: {row.fix}"))
    columns = (Column(""), Column("what"), Column("found"))
    return Table("doctor", "", columns, tuple(lines))


# --- packages ----------------------------------------------------------------------------------


def check_packages(name: str, extra: str = "") -> Check:
    """Look at the packages of an extra; without one, at those that are always needed."""
    name = f"{name} [{extra}]" if extra else name
    try:
        needed = _requirements(DISTRIBUTION, extra)
        problems = [problem for requirement in needed for problem in _problems(requirement)]
    except metadata.PackageNotFoundError:
        needed, problems = [], [f"{DISTRIBUTION} itself is not installed"]
    if not problems:
        found = [f"{item.name} {metadata.version(item.name)}" for item in needed]
        return Check(name, True, ", ".join(found))
    if extra:
        return Check(name, None, ", ".join(problems), f'pip install "{DISTRIBUTION}[{extra}]"')
    return Check(name, False, ", ".join(problems), f"pip install --upgrade {DISTRIBUTION}")


def _requirements(distribution: str, extra: str) -> list[Requirement]:
    """Return what a distribution needs here for one of its extras, or without any (`""`)."""

    def applies(requirement: Requirement, extra: str) -> bool:
        return requirement.marker is None or requirement.marker.evaluate({"extra": extra})

    requirements = [Requirement(line) for line in metadata.requires(distribution) or ()]
    return [one for one in requirements if applies(one, extra) and not (extra and applies(one, ""))]


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


def check_opencv() -> Check:
    """Look whether two packages of OpenCV overwrite each other's files."""
    found = []
    for name in ("opencv-python", "opencv-python-headless"):
        with suppress(metadata.PackageNotFoundError):
            found.append(f"{name} {metadata.version(name)}")
    if len(found) < 2:
        return Check("OpenCV", True if found else None, "".join(found) or "not installed")
    return Check(
        "OpenCV",
        False,
        f"{', '.join(found)} overwrite each other's files",
        "pip uninstall -y opencv-python opencv-python-headless && "
        'pip install "opencv-python-headless<4.14"',
    )


# --- video ---------------------------------------------------------------------------------------


def check_video(codecs: Sequence[tuple[str, str]]) -> Check:
    """Look for codecs in PyAV's own FFmpeg."""
    name = "Video (PyAV)"
    fix = 'pip install --force-reinstall --only-binary av "av>=14"'
    try:
        import av
    except ImportError as error:
        return Check(name, False, str(error), fix)
    versions = f"FFmpeg {av.ffmpeg_version_info} in PyAV {av.__version__}"
    for codec, mode in codecs:
        try:
            av.codec.Codec(codec, mode)
        except ValueError:
            what = "encoder" if mode == "w" else "decoder"
            return Check(name, False, f"{versions} has no {what} {codec}", fix)
    return Check(name, True, f"{versions} with {', '.join(codec for codec, _ in codecs)}")


def check_shared_ffmpeg(versions: Sequence[int]) -> Check:
    """Look for FFmpeg's shared libraries."""
    name = "FFmpeg's shared libraries"
    mac = sys.platform == "darwin"
    for version in versions:
        library = f"libavutil.{version}.dylib" if mac else f"libavutil.so.{version}"
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return Check(name, True, f"{library}, for torchcodec")
    install = "brew install ffmpeg" if mac else "sudo apt-get install ffmpeg"
    return Check(name, None, "not found; only torchcodec needs them", install)


# --- simulators ----------------------------------------------------------------------------------


def check_renderer(module: str = RENDERER, seconds: float = RENDERER_S) -> Check:
    """Let the simulator's renderer draw a picture."""
    name, only = "Vulkan", "; only simulators need it"
    if util.find_spec("sapien") is None:
        return Check(name, None, f"not tried without sapien{only}")
    fix = "sudo make vulkan (in a checkout, on Debian), or install your GPU's Vulkan driver"
    try:
        done = subprocess.run(
            [sys.executable, "-m", module],
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Check(name, None, f"a driver did not answer within {seconds:g} s{only}", fix)
    if done.returncode == 0:
        return Check(name, True, f"drawn with {done.stdout.strip()}")
    words = done.stderr.strip().splitlines() or [f"a driver crashed (exit code {done.returncode})"]
    return Check(name, None, words[-1] + only, fix)


def check_robomme() -> Check:
    """Have RoboMME play a demonstration with each of its arms, if its interpreter is named."""
    from robomme_interference_data.simulators.robomme.process import PYTHON_VARIABLE
    from robomme_interference_data.simulators.robomme.simulator import ARMS, RoboMMESimulator

    from .console import say

    name = "Official simulator"
    fix = f"export {PYTHON_VARIABLE}=PATH, the Python of an environment that has RoboMME"
    python = os.environ.get(PYTHON_VARIABLE)
    if not python:
        detail = f"{PYTHON_VARIABLE} is not set; only --simulator robomme needs it"
        return Check(name, None, detail, fix)
    played = " and ".join(f"{family}/test/0" for family in ARMS)
    say(f"RoboMME plays {played}, one with each of its arms: a minute or so")
    try:
        with RoboMMESimulator(python, answer_s=ROBOMME_S) as simulator:
            versions = [f"{key} {value}" for key, value in simulator.versions.items()]
            for family in ARMS:
                simulator.reset(f"{family}/test/0")
    except InterferenceError as error:
        return Check(name, False, first_line(error), fix)
    return Check(name, True, f"{python}: {', '.join(versions)}")


# --- the Hub -------------------------------------------------------------------------------------


def check_hub_token() -> Check:
    """Look for a token; it is not shown."""
    from huggingface_hub import get_token

    if get_token():
        return Check("Hub token", True, "found")
    return Check("Hub token", None, "none; only private datasets need it", "hf auth login")


def check_hub_cache() -> Check:
    """Look whether the Hub's cache can be written, and how much room it has."""
    from huggingface_hub import constants

    cache = Path(constants.HF_HUB_CACHE)
    existing = next(folder for folder in (cache, *cache.parents) if folder.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        fix = "export HF_HOME=FOLDER, a folder that you may write to"
        return Check("Hub cache", None, f"{cache} cannot be written", fix)
    free = shutil.disk_usage(existing).free / 1e9
    return Check("Hub cache", True, f"{cache}, {free:.0f} GB free")
