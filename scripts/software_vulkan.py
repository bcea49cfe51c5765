"""Install Mesa's software Vulkan driver on Debian where no Vulkan device can render.

Nothing but the simulators needs Vulkan, so whatever goes wrong here is one line and no failure.
Standard library only: root may have another Python than the virtual environment.

Debian 12's own driver is too old for the simulator. The suite bookworm-backports has a newer one;
it is added with the mirror and key of the machine's own package sources.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PROBE = Path(__file__).parent.parent / "robomme_interference_data" / "vulkan.py"
PACKAGES = ("libvulkan1", "mesa-vulkan-drivers")
TOO_OLD_IN = "bookworm"
"""The Debian release whose driver is too old, and whose backports have a newer one."""

APT = ("apt-get", "-qq", "-o", "DPkg::Lock::Timeout=300", "-o", "Acquire::http::Timeout=30")


def main() -> None:
    """Install the driver if it is missing, and say in one line what stands in the way."""
    if not sys.platform.startswith("linux") or can_render():
        return
    if shutil.which("apt-get") is None:
        say("install the Vulkan driver of your GPU, or Mesa's software driver (25.0 works)")
    elif os.geteuid() != 0:
        say("to install Mesa's software driver, run: sudo make vulkan")
    else:
        print("setup: installing Mesa's software Vulkan driver ...", file=sys.stderr)
        problem = install(Path("/etc/apt"))
        if problem is not None:
            say(f"installing Mesa's software driver failed: {problem}")
        elif not can_render():
            say("the Mesa that apt installs is too old (25.0 works)")


def say(what_to_do: str) -> None:
    """Print the one line."""
    print(
        f"setup: no Vulkan device can render (simulators need one): {what_to_do}", file=sys.stderr
    )


def can_render() -> bool:
    """Tell whether a Vulkan device of this machine can render."""
    try:
        done = subprocess.run(
            [sys.executable, "-I", str(PROBE)], capture_output=True, timeout=20, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def install(apt_folder: Path) -> str | None:
    """Install the driver with apt.

    Returns:
        None, or why it failed; then the package sources are as they were.
    """
    release = platform.freedesktop_os_release().get("VERSION_CODENAME", "")
    suite = f"{release}-backports" if release == TOO_OLD_IN else None
    added = None
    if suite is not None and not any(entries(apt_folder, suite)):
        found = sorted(entries(apt_folder, release), key=is_third_party)
        if not found:
            return f"{apt_folder} has no entry for {release} main"
        kind, entry = found[0]
        added = apt_folder / "sources.list.d" / f"{suite}{kind}"
        added.write_text(with_suite(kind, entry, suite), encoding="utf-8")
    target = () if suite is None else ("--target-release", suite)
    try:
        not_updated = run(*APT, "-o", "APT::Update::Error-Mode=any", "update")
        problem = run(*APT, "install", "--yes", "--no-install-recommends", *target, *PACKAGES)
        if problem is not None and not_updated is not None:
            problem = not_updated  # the cause; without consequence where the install succeeds
    except BaseException:
        problem = "interrupted"
        raise
    finally:
        if added is not None and problem is not None:
            added.unlink()
    return problem


def run(*command: str) -> str | None:
    """Run a command silently.

    Returns:
        None, or if it failed its first line that is an error of apt's, or else its last line.
    """
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
        check=False,
    )
    if done.returncode == 0:
        return None
    lines = done.stdout.strip().splitlines() or [f"{command[0]} exited with {done.returncode}"]
    return next((line for line in lines if line.startswith("E: ")), lines[-1])


ONE_LINE = re.compile(r"(deb\s+(?:\[[^]]*\]\s+)?\S+\s+)(\S+)(\s.*\bmain\b.*)")
"""An entry of a `.list` file: type, options and mirror; suite; components."""


def entries(apt_folder: Path, suite: str) -> Iterator[tuple[str, str]]:
    """Yield the enabled entries for the component main of a suite.

    Yields:
        `.list` and a line, or `.sources` and a paragraph without its comments.
    """
    for path in [apt_folder / "sources.list", *sorted((apt_folder / "sources.list.d").glob("*"))]:
        if path.suffix == ".list" and path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                match = ONE_LINE.fullmatch(line.partition("#")[0].strip())
                if match and match[2] == suite:
                    yield ".list", match[0]
        elif path.suffix == ".sources":
            text = re.sub(r"(?m)^#.*\n?", "", path.read_text(encoding="utf-8"))
            for paragraph in re.split(r"\n\s*\n", text):
                if (
                    suite in words(paragraph, "Suites")
                    and "main" in words(paragraph, "Components")
                    and "deb" in words(paragraph, "Types")
                    and words(paragraph, "Enabled") != ["no"]
                ):
                    yield ".sources", paragraph.strip()


def words(paragraph: str, field: str) -> list[str]:
    """Return the words of a field, which may go on over indented lines."""
    match = re.search(rf"(?mi)^{field}:(.*(?:\n[ \t].*)*)", paragraph)
    return match[1].split() if match else []


def is_third_party(entry: tuple[str, str]) -> bool:
    """Tell whether an entry is signed with a key that is not Debian's archive key."""
    text = entry[1].lower()
    return "signed-by" in text and "debian-archive" not in text


def with_suite(kind: str, entry: str, suite: str) -> str:
    """Return the same entry, mirror and key included, for another suite."""
    if kind == ".list":
        return ONE_LINE.sub(rf"\g<1>{suite}\g<3>", entry) + "\n"
    return re.sub(r"(?mi)^Suites:.*(\n[ \t].*)*", f"Suites: {suite}", entry) + "\n"


if __name__ == "__main__":
    main()
