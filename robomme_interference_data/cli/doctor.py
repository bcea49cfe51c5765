"""Check which parts of the package work on this machine, and how to fix the others.

Nothing heavy is imported: versions come from the metadata of installed packages, and the simulators
are tried in other processes. A check that raises is a failed check, and the others still run.
"""

import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata, util
from pathlib import Path

from packaging.requirements import Requirement

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    SimulatorCrashError,
    first_line,
)
from robomme_interference_data.package import DISTRIBUTION, install_source
from robomme_interference_data.storage.hub import check_endpoint

RENDERER = "robomme_interference_data.simulators.tabletop.renderer"
"""Draws an image in a process of its own, since a broken driver can crash or hang it."""

ORACLE_EPISODE = "VideoUnmask/test/0"
"""The shortest of RoboMME's episodes."""

TORCH_EXTRAS = ("build", "sim", "retrieval", "vlm", "train")
"""Extras with PyTorch, whose build for Linux has all of CUDA."""

RENDERER_S, ROBOMME_S, HUB_S = 30, 120, 10
"""Time limits of the checks, in seconds."""


@dataclass(frozen=True)
class Check:
    """The result of a check.

    Attributes:
        name: What was checked.
        ok: True if it works, False if something required does not, None if something optional is
            missing or does not work.
        detail: Versions, or the problem.
        fix: The command that fixes the problem; None if there is none.
    """

    name: str
    ok: bool | None
    detail: str
    fix: str | None = None


def checks() -> list[Check]:
    """Run all checks, which takes some seconds."""
    return [
        Check("Python", True, f"{platform.python_version()} ({sys.executable})"),
        guarded("Core libraries", check_packages),
        guarded("Video (PyAV)", check_video),
        *[guarded(f"Extra [{extra}]", partial(check_packages, extra)) for extra in extras()],
        guarded("OpenCV", check_opencv),
        guarded("Vulkan", check_renderer),
        guarded("Official simulator", check_robomme),
        guarded("Hub cache", check_cache),
        guarded("Hugging Face Hub", check_hub),
    ]


def guarded(name: str, check: Callable[[], Check]) -> Check:
    """Run a check; an exception becomes a failed check."""
    try:
        return check()
    except InterferenceError as error:
        return Check(name, False, error.message, error.hint)
    except Exception as error:
        return Check(name, False, f"{type(error).__name__}: {first_line(error)}")


def report(rows: Sequence[Check]) -> str:
    """Return the results as text for a terminal, each fix below its problem.

    Fixes are not wrapped, so that they can be copied.
    """
    states = {True: "ok", False: "FAILS", None: "optional"}
    longest = max(len(row.name) for row in rows)
    lines = []
    for row in rows:
        lines.append(f"{states[row.ok]:8}  {row.name:{longest}}  {row.detail}")
        if row.fix is not None:
            lines.append(f"{'':8}  fix: {row.fix}")
    return "\n".join(lines)


def extras() -> list[str]:
    """Return the names of this package's extras; none if its metadata are broken."""
    try:
        names = metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or ()
    except metadata.PackageNotFoundError:  # `check_packages` reports it
        return []
    return [name for name in names if name != "all"]


def check_packages(extra: str = "") -> Check:
    """Check the packages of an extra, or those that are always required."""
    name = f"Extra [{extra}]" if extra else "Core libraries"
    required = _requirements(DISTRIBUTION, extra)
    problems = [problem for requirement in required for problem in _problems(requirement)]
    if not problems and not extra:
        problems = [*_unusable()]
    if not problems:
        versions = ", ".join(
            f"{package.name} {metadata.version(package.name)}" for package in required
        )
        return Check(name, True, versions)
    if extra:
        if extra in TORCH_EXTRAS and util.find_spec("torch") is None:
            problems.append("brings PyTorch for CUDA, 5 GB; for the CPU: uv, --torch-backend cpu")
        return Check(name, None, ", ".join(problems), f'pip install "{DISTRIBUTION}[{extra}]"')
    fix = f"pip install --force-reinstall {install_source()}"
    return Check(name, False, ", ".join(problems), fix)


def _unusable() -> Iterator[str]:
    """Yield required libraries that cannot be imported; PyAV has a check of its own."""
    for module in ("numpy", "pyarrow", "huggingface_hub"):
        try:
            import_module(module)
        except Exception as error:  # a broken library may raise anything
            yield f"{module} cannot be imported: {first_line(error)}"


def _requirements(distribution: str, extra: str) -> list[Requirement]:
    """Return what a distribution requires here for an extra, or without any (`""`)."""

    def applies(requirement: Requirement, extra: str) -> bool:
        return requirement.marker is None or requirement.marker.evaluate({"extra": extra})

    requirements = [Requirement(line) for line in metadata.requires(distribution) or ()]
    return [
        requirement
        for requirement in requirements
        # Those of an extra are asked for alone.
        if applies(requirement, extra) and (not extra or not applies(requirement, ""))
    ]


def _problems(requirement: Requirement) -> Iterator[str]:
    """Yield missing packages and wrong versions, including the extras of the requirement."""
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


def check_video() -> Check:
    """Check that PyAV can decode datasets, and can encode them, which only builds need."""
    # Wheels of later versions do not contain the encoder.
    fix = 'pip install --force-reinstall --no-deps --only-binary av "av>=15,<16"'
    try:
        import av
    except ImportError as error:
        return Check("Video (PyAV)", False, str(error), fix)
    for codec, ok, effect in (
        ("libdav1d", False, "videos cannot be decoded"),
        ("libaom-av1", None, "datasets cannot be built, only loaded"),
    ):
        if codec not in av.codecs_available:
            problem = f"PyAV {av.__version__} has no {codec}: {effect}"
            return Check("Video (PyAV)", ok, problem, fix)
    return Check("Video (PyAV)", True, f"PyAV {av.__version__} with libdav1d and libaom-av1")


def check_renderer(module: str = RENDERER, seconds: float = RENDERER_S) -> Check:
    """Check that the simulators' renderer can draw."""
    if util.find_spec("sapien") is None:
        return Check("Vulkan", None, "not tried without sapien; only simulators need it")
    fix = "sudo make vulkan (in a checkout, on Debian), or install your GPU's Vulkan driver"
    command = [sys.executable, "-m", module]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        problem = f"the driver did not answer within {seconds:g} s"
    else:
        if done.returncode == 0:
            return Check("Vulkan", True, f"drawn with {done.stdout.strip()}")
        crash = f"the driver crashed (exit code {done.returncode})"
        problem = (done.stderr.strip().splitlines() or [crash])[-1]
    return Check("Vulkan", None, f"{problem}; only simulators need it", fix)


def check_robomme() -> Check:
    """Check that RoboMME's own solvers solve an episode, if its interpreter is configured."""
    from robomme_interference_data.simulators.play import play
    from robomme_interference_data.simulators.remote.interpreter import python_variable
    from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator

    name, variable = "Official simulator", python_variable(RoboMMESimulator.name)
    python = os.environ.get(variable)
    if not python:
        fix = f"export {variable}=PATH, the Python of an environment that has RoboMME"
        return Check(name, None, f"only --simulator robomme needs {variable}", fix)
    another = f"set {variable}, now {python}, to the Python of an environment that has RoboMME"
    shows_output = f"robomme-interference simulate {ORACLE_EPISODE} --simulator robomme"
    try:
        versions = [f"{key} {value}" for key, value in RoboMMESimulator.versions().items()]
        with RoboMMESimulator(None, (), ROBOMME_S, subgoals=False) as simulator:
            patches = ", ".join(simulator.patches) or "nothing"
            status = play(simulator, ORACLE_EPISODE, "oracle", None)["status"]
    except InvalidOptionError as error:
        return Check(name, False, error.message, another)
    except SimulatorCrashError as error:
        return Check(name, False, error.message, f"{shows_output}, which shows its last output")
    except InterferenceError as error:
        # Its advice for whoever has set nothing is the other one's.
        advice = RoboMMESimulator.interpreter().advice
        return Check(name, False, error.message, another if error.hint == advice else error.hint)
    detail = (
        f"{python}: {', '.join(versions)}; patched: {patches}; {ORACLE_EPISODE} with its own "
        f"solvers: {status}"
    )
    return Check(name, status == "success", detail, None if status == "success" else shows_output)


def check_opencv() -> Check:
    """Check that one distribution installs `cv2`: two overwrite each other's files."""
    name = "OpenCV"
    found = sorted({*metadata.packages_distributions().get("cv2", ())})
    if not found:
        return Check(name, None, "not installed; only the extras build and sim need it")
    versions = [f"{distribution} {metadata.version(distribution)}" for distribution in found]
    if len(found) == 1:
        return Check(name, True, versions[0])
    problem = f"{' and '.join(versions)} overwrite each other's files"
    # LeRobot requires the headless one, and for sapien it is enough.
    fix = f'pip uninstall --yes {" ".join(found)} && pip install "opencv-python-headless<4.14"'
    return Check(name, None, problem, fix)


def check_cache() -> Check:
    """Check that downloads can be written to the Hub's cache."""
    check_endpoint()
    from huggingface_hub.constants import HF_HUB_CACHE

    existing = next(
        path for path in (Path(HF_HUB_CACHE), *Path(HF_HUB_CACHE).parents) if path.exists()
    )
    try:
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        problem = f"{HF_HUB_CACHE} cannot be written: {error.strerror}"
        return Check("Hub cache", False, problem, "export HF_HOME=FOLDER, one that you can write")
    return Check("Hub cache", True, HF_HUB_CACHE)


def check_hub() -> Check:
    """Check that the Hub answers and accepts the token, which is never shown."""
    check_endpoint()
    from huggingface_hub import HfApi, constants, get_token
    from huggingface_hub.errors import HfHubHTTPError
    from huggingface_hub.utils import get_session, httpx  # its HTTP library: httpx, or httpx2

    name, hub, token = "Hugging Face Hub", constants.ENDPOINT, get_token()
    if constants.HF_HUB_OFFLINE:
        return Check(name, None, "HF_HUB_OFFLINE is set", "unset HF_HUB_OFFLINE")
    try:
        get_session().head(hub, timeout=HUB_S)
        if token is None:
            problem = f"{hub} answers; private datasets need a token"
            return Check(name, None, problem, "hf auth login")
        return Check(name, True, f"{hub} answers {HfApi().whoami(token)['name']}")
    except HfHubHTTPError:
        return Check(name, False, f"{hub} rejects the token", "hf auth login --force")
    except httpx.HTTPError as error:
        fix = "check the network, and HF_ENDPOINT if it is set"
        return Check(name, None, f"{hub} does not answer: {first_line(error)}", fix)
