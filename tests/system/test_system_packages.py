"""Vulkan driver and Chromium come from the machine's own package sources, or it is said why not."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "system_packages.sh"
TOOLS = ("awk", "bash", "dirname", "env", "grep", "head", "rm", "sed", "tail", "touch")

# Each stands in for a command of Debian's. `apt-get install` makes the file that says that
# something is there, unless it is told to fail; it notes the sources that it was given.
FAKES = {
    "apt-get": """
echo "$*" >> "$STATE/calls"
case "$*" in
  *"Codename: bookworm-backports"*) [[ ! -e $STATE/backports ]] || echo "known:1" ;;
  *"Codename: bookworm"*) echo "$ENTRY" ;;
  *update*) [[ -z ${NO_UPDATE:-} ]] || { echo "E: no mirror"; exit 100; } ;;
  *install*)
    cat "$STATE"/parts/bookworm-backports.* > "$STATE/source" 2>/dev/null
    [[ -z ${FAILS:-} ]] || { echo chatter; echo "E: cause"; echo "E: consequence"; exit 100; }
    case "$*" in *chromium*) cp "$0" "$(dirname "$0")/chromium" ;; *) touch "$STATE/mesa" ;; esac
esac
""",
    "apt-cache": 'echo "  Candidate: ${CANDIDATE:-22.3.6-1}"',
    "apt-config": "echo \"folder='$STATE/parts/'\"",
    "dpkg-query": '[[ -e $STATE/mesa ]] && echo "installed ${MESA:-25.0.7-2~bpo12+1}"',
    "dpkg": '[[ $(printf "%s\\n" "$2" "$4" | sort -V | head -n 1) == "$4" ]]',
    "id": 'echo "${USER_ID:-0}"',
}


class Machine:
    """A Debian machine with nothing installed."""

    def __init__(self, folder: Path):
        self.state, self.bin = folder / "state", folder / "bin"
        (self.state / "parts").mkdir(parents=True)
        self.bin.mkdir()
        for name in (*TOOLS, "cat", "cp", "sort"):
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
        """What apt-get installed, and from which suite."""
        lines = (self.state / "calls").read_text(encoding="utf-8").splitlines()
        return [
            line.rpartition("--no-install-recommends ")[2] for line in lines if " install " in line
        ]


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


DEB822 = """\
# Modernized.

Types: deb
URIs: file:///mirror/debian-security
Suites: bookworm-security
Components: main
Signed-By: /keys/debian-archive-keyring.gpg

Types: deb deb-src
URIs: file:///mirror/debian
# Not this one.
Suites: bookworm bookworm-updates
Components: main contrib
Signed-By: /keys/debian-archive-keyring.gpg
"""
DEB822_BACKPORTS = """\
Types: deb deb-src
URIs: file:///mirror/debian
Suites: bookworm-backports
Components: main contrib
Signed-By: /keys/debian-archive-keyring.gpg
"""
INLINE_KEY = """\
Types: deb
Suites:
 bookworm
 bookworm-updates
URIs: file:///mirror/debian
Components: main
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 .
 mQINBF
"""
INLINE_BACKPORTS = INLINE_KEY.replace("\n bookworm\n bookworm-updates", " bookworm-backports")
LIST = "# local\ndeb [arch=amd64 signed-by=/keys/archive.gpg] file:///m/ bookworm main\n"
LIST_BACKPORTS = "deb [arch=amd64 signed-by=/keys/archive.gpg] file:///m/ bookworm-backports main\n"


@pytest.mark.parametrize(
    ("name", "number", "text", "backports"),
    [
        ("debian.sources", 2, DEB822, DEB822_BACKPORTS),
        ("inline.sources", 1, INLINE_KEY, INLINE_BACKPORTS),
        ("sources.list", 2, LIST, LIST_BACKPORTS),
    ],
)
@pytest.mark.parametrize("works", [True, False])
def test_the_backports_have_the_mirror_and_key_of_the_release(
    machine: Machine, name: str, number: int, text: str, backports: str, works: bool
) -> None:
    (machine.state / name).write_text(text, encoding="utf-8")
    entry = f"{machine.state / name}:{number}"
    said = machine.set_up("vulkan", ENTRY=entry, FAILS="" if works else "1")
    assert machine.calls() == ["--target-release bookworm-backports mesa-vulkan-drivers"]
    assert (machine.state / "source").read_text(encoding="utf-8") == backports
    kept = [path.name for path in (machine.state / "parts").iterdir()]
    if works:
        assert kept == [f"bookworm-backports.{name.partition('.')[2]}"]
        assert said == "setup: installing vulkan ...\n"
    else:  # leaves the package sources as they were
        assert kept == []
        assert said.endswith("installing vulkan failed: E: cause\n")


def test_backports_that_are_there_are_used(machine: Machine) -> None:
    (machine.state / "backports").touch()
    machine.set_up("vulkan")
    assert machine.calls() == ["--target-release bookworm-backports mesa-vulkan-drivers"]
    assert list((machine.state / "parts").iterdir()) == []


def test_nothing_is_said_where_nothing_is_missing(machine: Machine) -> None:
    said = machine.set_up(CANDIDATE="25.2.1-1")
    assert said == "setup: installing vulkan ...\nsetup: installing chromium ...\n"
    assert machine.calls() == ["mesa-vulkan-drivers", "chromium"]
    assert machine.set_up() == ""
    assert len(machine.calls()) == 2


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({}, "apt knows no Mesa of 24.3 or newer"),
        ({"CANDIDATE": "25.2.1-1", "MESA": "22.3.6-1"}, "will not do"),
        ({"CANDIDATE": "25.2.1-1", "FAILS": "1"}, "failed: E: cause"),
        ({"CANDIDATE": "25.2.1-1", "FAILS": "1", "NO_UPDATE": "1"}, "failed: E: no mirror"),
        ({"USER_ID": "1000"}, "run: sudo make vulkan"),
    ],
)
def test_what_stands_in_the_way_of_vulkan_is_one_line(
    machine: Machine, environment: dict[str, str], said: str
) -> None:
    lines = machine.set_up("vulkan", **environment).splitlines()
    assert lines[-1].startswith("setup: no Vulkan device can render (simulators need one): ")
    assert lines[-1].endswith(said)


def test_what_to_do_without_apt_and_without_root(machine: Machine) -> None:
    assert machine.set_up("chromium", USER_ID="1000") == (
        "setup: no Chromium (browser tests are skipped): run: sudo apt-get install chromium\n"
    )
    (machine.bin / "apt-get").unlink()
    vulkan, chromium = machine.set_up().splitlines()
    assert vulkan.endswith(
        "install the driver of your GPU, or Mesa's software driver, 24.3 or newer"
    )
    assert chromium.endswith("install Chromium or Chrome")
