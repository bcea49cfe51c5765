"""Install the package by its name as a new user does, without pins, and use it: `make bare`.

It is uploaded to a package index on the loopback interface, and installed from there. Once with the
newest versions that the configured index serves and once with the lowest that `pyproject.toml`
declares: the pins of `.venv` hide what breaks with either. Every extra is resolved, not installed.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from distribution import ROOT, build, configured_index, uploaded
from support.hub import BUFFER_SET, push_buffer_set
from support.hub_server import HubServer
from support.package import HEAVY

from robomme_interference_data import load_buffer

GOLDEN = ROOT / "tests" / "golden"
UV = Path(sys.executable).with_name("uv")
QUERY, CONDITION = "MoveCube/test/0", "k3"
NOWHERE = "http://127.0.0.1:9"
"""An endpoint where nothing listens."""

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NAME: str = PROJECT["name"]
VERSION: str = PROJECT["version"]
CORE: list[str] = PROJECT["dependencies"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]

LOAD = """
import hashlib, sys
from importlib.util import find_spec
from robomme_interference_data import load_buffer

buffer = load_buffer(sys.argv[2], sys.argv[3], buffer_set=sys.argv[1], verify=True)
arrays = (buffer.frames("front"), buffer.frames("wrist"), buffer.states)
print(*[hashlib.sha256(array.tobytes()).hexdigest() for array in arrays])
print(*[name for name in sys.argv[4:] if find_spec(name)])
"""


def main() -> None:
    """Check both resolutions; exit with an error at the first thing that fails."""
    with tempfile.TemporaryDirectory(prefix="distributions-") as folder:
        build(Path(folder))
        check_installs(Path(folder), "highest", "lowest-direct")


def check_installs(distributions: Path, *resolutions: str) -> None:
    """Upload distributions to an index on loopback, and install and use them from there."""
    os.environ["UV_DEFAULT_INDEX"] = configured_index()
    with (
        tempfile.TemporaryDirectory(prefix="bare-install-") as folder,
        hub(Path(folder)) as server,
        uploaded(distributions) as index,
    ):
        for resolution in resolutions:
            BareInstall(Path(folder), index.simple, resolution, server.endpoint).check()


@contextmanager
def hub(folder: Path) -> Iterator[HubServer]:
    """Run a Hub on the loopback interface that holds the golden buffer set."""
    with HubServer().running() as server:
        push_buffer_set(server, GOLDEN / "buffer_set", folder / "pushed")
        yield server


class BareInstall:
    """An environment with the package and what it requires, and nothing else."""

    def __init__(self, folder: Path, index: str, resolution: str, endpoint: str):
        self.folder = folder / resolution
        self.index = index
        self.resolution = resolution
        self.programs = self.folder / "venv" / "bin"
        own = {"HF_ENDPOINT": endpoint, "HF_HOME": str(self.folder / "hub"), "HF_HUB_OFFLINE": "0"}
        self.env = os.environ | own | {"HF_HUB_DISABLE_XET": "1"}

    def check(self) -> None:
        """Install the core, use it, resolve the extras, and score."""
        self.folder.mkdir()
        self.uv("venv", "--python", sys.executable, self.folder / "venv")
        self.install()
        self.check_loading()
        self.check_errors()
        self.check_doctor()
        for extra in EXTRAS:
            self.install(extra, "--dry-run")
        self.install("score")
        self.command("score", GOLDEN / "run", "--out", self.folder / "score")
        expect((self.folder / "score" / "report.html").is_file(), "score wrote no report")
        print(f"bare install: works with the {self.resolution} versions")

    def install(self, extra: str | None = None, *options: str) -> None:
        """Install the package; its requirements are named too, which makes them direct ones."""
        extras = "" if extra is None else f"[{extra}]"
        required = CORE + [one for one in EXTRAS.get(extra or "", []) if not one.startswith(NAME)]
        python = ("--python", self.programs / "python")
        # An earlier index on loopback may have had the same port.
        index = ("--index", self.index, "--refresh-package", NAME, "--resolution", self.resolution)
        package = f"{NAME}{extras}=={VERSION}"
        self.uv("pip", "install", *python, *index, *options, package, *required)

    def uv(self, *arguments: str | Path) -> None:
        """Run uv outside the checkout, whose settings for uv a user does not have."""
        command = [UV, *arguments, "--quiet"]
        subprocess.run(command, cwd=self.folder, env=self.env, check=True, timeout=300)

    def check_loading(self) -> None:
        """Load the same frames as `.venv` does, from a folder and from the Hub."""
        golden = GOLDEN / "buffer_set"
        buffer = load_buffer(QUERY, CONDITION, buffer_set=golden)
        arrays = (buffer.frames("front"), buffer.frames("wrist"), buffer.states)
        expected = " ".join(hashlib.sha256(array.tobytes()).hexdigest() for array in arrays)
        for source in (str(golden), BUFFER_SET):
            loaded = self.run("python", "-I", "-c", LOAD, source, QUERY, CONDITION, *HEAVY)
            digests, installed = loaded.stdout.splitlines()
            expect(digests == expected, f"the frames of {source} differ")
            expect(not installed, f"the light core brings {installed}")
        self.command("list", BUFFER_SET)
        self.command("fetch", BUFFER_SET, "--to", self.folder / "fetched")
        self.command("list", self.folder / "fetched")

    def check_errors(self) -> None:
        """Get an error line, not a traceback, for what the Hub lacks and without a Hub."""
        for endpoint, repository, error in (
            (self.env["HF_ENDPOINT"], "someone/absent", "does not exist"),
            (NOWHERE, "someone/other", "cannot be reached"),
        ):
            done = self.command("list", repository, endpoint=endpoint, code=1)
            expect(done.stderr.startswith("Error:") and error in done.stderr, done.stderr)

    def check_doctor(self) -> None:
        """Get a row for every part, with and without a Hub."""
        for endpoint in (self.env["HF_ENDPOINT"], NOWHERE):
            done = self.command("doctor", "--json", endpoint=endpoint)
            parts = {row["name"]: row for row in json.loads(done.stdout)}
            expect(parts["Core libraries"]["ok"] is True, str(parts))
            expect(endpoint in parts["Hugging Face Hub"]["detail"], str(parts))

    def command(
        self, *arguments: str | Path, endpoint: str | None = None, code: int = 0
    ) -> subprocess.CompletedProcess[str]:
        """Run the command line."""
        return self.run("robomme-interference", *arguments, endpoint=endpoint, code=code)

    def run(
        self, program: str, *arguments: str | Path, endpoint: str | None = None, code: int = 0
    ) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment, which must end with an exit code."""
        done = subprocess.run(
            [self.programs / program, *arguments],
            cwd=self.folder,
            env=self.env | {"HF_ENDPOINT": endpoint or self.env["HF_ENDPOINT"]},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        command = " ".join(map(str, (program, *arguments)))
        expect(done.returncode == code, f"{command}: {done.returncode}\n{done.stdout}{done.stderr}")
        return done


def expect(condition: bool, what: str) -> None:
    """Exit with an error if a condition does not hold."""
    if not condition:
        sys.exit(f"bare install: {what}")


if __name__ == "__main__":
    main()
