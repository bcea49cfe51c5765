"""Vulkan driver and Chromium: installed where they are missing, or one line says why not."""

import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "system_packages.sh"
TOOLS = ("awk", "bash", "cat", "cp", "dirname", "env", "grep", "head", "rm", "sed", "sort")
TOOLS += ("tail", "touch")

# Each stands in for a command of Debian's. `apt-get install` makes the file that says that
# something is there, unless it is told to fail; it keeps the sources that it was given.
FAKES = {
    "apt-get": """
case "$*" in
  *"Codename: bookworm-backports"*) ;;
  *"Codename: bookworm"*) echo "$ENTRY" ;;
  *install*)
    all="$*"; echo "${all##*--no-install-recommends }" >> "$STATE/calls"
    cat "$STATE"/parts/bookworm-backports.* > "$STATE/source" 2>/dev/null
    [[ -z ${FAILS:-} ]] || { echo chatter; echo "E: cause"; echo "E: consequence"; exit 100; }
    case "$*" in *chromium*) cp "$0" "$(dirname "$0")/chromium" ;; *) touch "$STATE/mesa" ;; esac
esac
""",
    "apt-cache": 'echo "  Candidate: ${CANDIDATE:-22.3.6-1}"',
    "apt-config": "echo \"folder='$STATE/parts/'\"",
    "dpkg-query": '[[ -e $STATE/mesa ]] && echo "installed 25.0.7-2~bpo12+1"',
    "dpkg": '[[ $(printf "%s\\n" "$2" "$4" | sort -V | head -n 1) == "$4" ]]',
    "id": 'echo "${USER_ID:-0}"',
}
SOURCES = """\
Types: deb
URIs: file:///mirror/security
Suites: bookworm-security

Types: deb
# Not this one.
URIs: file:///mirror/debian
Suites: bookworm bookworm-updates
Signed-By: /keys/debian-archive-keyring.gpg
"""
BACKPORTS = """\
Types: deb
URIs: file:///mirror/debian
Suites: bookworm-backports
Signed-By: /keys/debian-archive-keyring.gpg
"""


class Machine:
    """A Debian machine with nothing installed."""

    def __init__(self, folder: Path):
        self.state, self.bin = folder / "state", folder / "bin"
        (self.state / "parts").mkdir(parents=True)
        self.bin.mkdir()
        for name in TOOLS:
            (self.bin / name).symlink_to(shutil.which(name) or name)
        for name, text in FAKES.items():
            (self.bin / name).write_text(f"#!/usr/bin/env bash\n{text}\n", encoding="utf-8")
            (self.bin / name).chmod(0o755)
        # Elsewhere than the checkout, whose .venv may be able to draw.
        (folder / "scripts").mkdir()
        self.script = Path(shutil.copy(SCRIPT, folder / "scripts"))

    def set_up(self, *words: str, **environment: str) -> str:
        """Run the script; return what it said. It never fails."""
        done = subprocess.run(
            [str(self.script), *words],
            env={"PATH": str(self.bin), "STATE": str(self.state), "ENTRY": "", **environment},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout == ""
        return done.stderr

    def calls(self) -> list[str]:
        """What apt-get was to install, and from which suite."""
        return (self.state / "calls").read_text(encoding="utf-8").splitlines()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_nothing_is_said_where_nothing_is_missing(machine: Machine) -> None:
    said = machine.set_up(CANDIDATE="25.2.1-1")
    assert said == "setup: installing vulkan ...\nsetup: installing chromium ...\n"
    assert machine.calls() == ["mesa-vulkan-drivers", "chromium"]
    assert machine.set_up() == ""


@pytest.mark.parametrize("fails", ["", "1"])
def test_the_backports_have_the_mirror_and_key_of_the_release(machine: Machine, fails: str) -> None:
    (machine.state / "debian.sources").write_text(SOURCES, encoding="utf-8")
    said = machine.set_up("vulkan", ENTRY=f"{machine.state}/debian.sources:2", FAILS=fails)
    assert machine.calls() == ["--target-release bookworm-backports mesa-vulkan-drivers"]
    assert (machine.state / "source").read_text(encoding="utf-8") == BACKPORTS
    kept = [path.name for path in (machine.state / "parts").iterdir()]
    assert kept == ([] if fails else ["bookworm-backports.sources"])  # no trace of a failure
    assert said.endswith("installing vulkan failed: E: cause\n" if fails else "vulkan ...\n")


def test_what_stands_in_the_way_is_one_line(machine: Machine) -> None:
    assert machine.set_up("vulkan", USER_ID="1000").endswith("run: sudo make vulkan\n")
    assert machine.set_up("vulkan").endswith("apt knows no Mesa of 24.3 or newer\n")
    (machine.bin / "apt-get").unlink()
    assert machine.set_up("chromium") == (
        "setup: no Chromium (browser tests are skipped): install Chromium or Chrome\n"
    )
