"""Find out what works on this machine, and which command mends what does not.

Nothing heavy is imported: installed versions are read from the packages' metadata, and other
processes find out whether the simulators work.
"""

import logging
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata, util

from packaging.requirements import Requirement

from robomme_interference_data.errors import InterferenceError, first_line
from robomme_interference_data.viz.tables import Column, Table

logger = logging.getLogger(__name__)

DISTRIBUTION = "robomme-interference-data"

RENDERER = "robomme_interference_data.simulators.tabletop.renderer"
"""The program that draws a picture: a broken driver can crash its process or never return."""

RENDERER_S, ROBOMME_S, HUB_S = 30, 120, 10
"""Seconds that the simulators and the Hub have to answer."""


@dataclass(frozen=True)
class Check:
    """One row of the doctor's table.

    Attributes:
        name: What was checked.
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
    """Check everything; takes a few seconds, and a minute more where RoboMME is."""
    return [
        Check("Python", True, f"{platform.python_version()} ({sys.executable})"),
        check_packages(),
        check_video(),
        *map(check_packages, extras()),
        check_renderer(),
        check_robomme(),
        check_hub(),
    ]


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


def extras() -> list[str]:
    """Return the names of this package's extras."""
    names = metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or ()
    return [name for name in names if name != "all"]


def check_packages(extra: str = "") -> Check:
    """Check the packages of an extra; without one, those that are always needed."""
    name = f"Extra [{extra}]" if extra else "Core libraries"
    needed = _requirements(DISTRIBUTION, extra)
    problems = [problem for requirement in needed for problem in _problems(requirement)]
    if not problems:
        found = ", ".join(f"{one.name} {metadata.version(one.name)}" for one in needed)
        return Check(name, True, found)
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


def check_video() -> Check:
    """Check that PyAV can decode videos of datasets, and encode them, which only builds need."""
    name, decoder, encoder = "Video (PyAV)", "libdav1d", "libaom-av1"
    fix = 'pip install --force-reinstall --only-binary av "av>=14"'
    try:
        import av
    except ImportError as error:
        return Check(name, False, str(error), fix)
    found = f"PyAV {av.__version__}"
    for ok, codec, what in ((False, decoder, "decoder"), (None, encoder, "encoder")):
        if codec not in av.codecs_available:
            return Check(name, ok, f"{found} has no {what} {codec}", fix)
    return Check(name, True, f"{found} with {decoder} and {encoder}")


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

    name = "Official simulator"
    fix = f"export {PYTHON_VARIABLE}=PATH, the Python of an environment that has RoboMME"
    python = os.environ.get(PYTHON_VARIABLE)
    if not python:
        detail = f"{PYTHON_VARIABLE} is not set; only the simulator robomme needs it"
        return Check(name, None, detail, fix)
    logger.info("RoboMME plays an episode with each of its arms: a minute or so")
    try:
        with RoboMMESimulator(python, answer_s=ROBOMME_S) as simulator:
            versions = [f"{key} {value}" for key, value in simulator.versions(python).items()]
            versions += [f"patched: {one}" for one in simulator.patches]
            for family in ARMS:
                simulator.reset(f"{family}/test/0")
    except InterferenceError as error:
        return Check(name, False, first_line(error), fix)
    return Check(name, True, f"{python}: {', '.join(versions)}")


def check_hub() -> Check:
    """Check that the Hub answers and knows the token, which is not shown."""
    import httpx
    from huggingface_hub import HfApi, constants, get_token
    from huggingface_hub.utils import get_session

    name, hub, token = "Hugging Face Hub", constants.ENDPOINT, get_token()
    if constants.HF_HUB_OFFLINE:
        return Check(name, None, "HF_HUB_OFFLINE is set", "unset HF_HUB_OFFLINE")
    try:
        if token is None:
            get_session().head(hub, timeout=HUB_S)
            detail = f"{hub} answers; without a token, which private datasets need"
            return Check(name, None, detail, "hf auth login")
        return Check(name, True, f"{hub} answers {HfApi().whoami(token)['name']}")
    except httpx.HTTPError as error:
        response = getattr(error, "response", None)
        if response is not None and response.status_code == httpx.codes.UNAUTHORIZED:
            return Check(name, False, f"{hub} does not know the token", "hf auth login --force")
        detail = f"{hub} does not answer: {first_line(error)}"
        return Check(name, None, detail, "check the network, and HF_ENDPOINT if it is set")
