"""Isolation: every test runs without the network and tokens, and with separate caches."""

import functools
import gc
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

ROOT = Path(__file__).parent.parent

# What a shell runs in its background begins with Ctrl-C ignored; tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The libraries read these when they are imported, so they are set before any test module is.
_SCRATCH = Path(tempfile.mkdtemp(prefix="robomme-interference-tests-"))
_REMOVED = (
    "FORCE_COLOR",
    "HF_ASSETS_CACHE",
    "HF_ENDPOINT",
    "HF_HUB_CACHE",
    "HF_TOKEN",
    "HF_TOKEN_PATH",
    "HF_XET_CACHE",
    "HUGGING_FACE_HUB_TOKEN",
    "ROBOMME_PYTHON",
)
_SET = {
    "COLUMNS": "120",  # tables and help texts are laid out alike everywhere
    "HF_DATASETS_CACHE": str(_SCRATCH / "datasets"),
    "HF_HOME": str(_SCRATCH / "huggingface"),
    "HF_HUB_DISABLE_IMPLICIT_TOKEN": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_DISABLE_XET": "1",  # a protocol that the server on the loopback interface has not
    "HF_HUB_OFFLINE": "1",  # a test with a server on the loopback interface sets it back
    "HF_LEROBOT_HOME": str(_SCRATCH / "lerobot"),
    "NO_COLOR": "1",
    "OMP_NUM_THREADS": "1",  # sums of floats depend on it; models this small are slower on more
    "XDG_CACHE_HOME": str(_SCRATCH / "cache"),
}
for _name in _REMOVED:
    os.environ.pop(_name, None)
os.environ.update(_SET)

# No deadline: the first example of a test may import a library. In CI the examples are the same
# in every run, so that a change is never blamed for what another one did.
for _profile, _examples in (("few", 30), ("all", 50)):
    hypothesis.settings.register_profile(
        _profile, max_examples=_examples, deadline=None, derandomize=bool(os.environ.get("CI"))
    )


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes the golden messages anew."""
    help_text = "write tests/golden/messages.json: what errors say in the tests that run"
    parser.addoption("--write-messages", action="store_true", help=help_text)


def pytest_configure(config: pytest.Config) -> None:
    """Take all of hypothesis' examples only where slow tests run, too."""
    from support import messages

    messages.configure(config)
    hypothesis.settings.load_profile("few" if config.option.markexpr else "all")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Let the garbage collector leave alone what lives to the end: modules and tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files whose few tests take long, so that no worker is left alone with one."""
    items.sort(key=lambda item: item.path.parent.name != "system")


def pytest_unconfigure() -> None:
    """Write the golden messages if that was asked for; remove the caches."""
    from support import messages

    messages.write_messages()
    shutil.rmtree(_SCRATCH, ignore_errors=True)


@pytest.fixture(autouse=True, scope="session")
def _loopback_only() -> Iterator[None]:
    """Refuse connections that would leave this machine."""
    lookup = socket.getaddrinfo

    def check(host: Any) -> None:
        name = host.decode() if isinstance(host, bytes) else host
        if name not in (None, "", "localhost", "::1") and not str(name).startswith("127."):
            raise OSError(f"tests may not reach {name}: only the loopback interface is open")

    def guarded_lookup(host: Any, *rest: Any, **options: Any) -> Any:
        check(host)
        return lookup(host, *rest, **options)

    def guarded(connect: Callable[..., Any]) -> Callable[..., Any]:
        def call(self: socket.socket, address: Any) -> Any:
            if isinstance(address, tuple):
                check(address[0])
            return connect(self, address)

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket, "getaddrinfo", guarded_lookup)
        for name in ("connect", "connect_ex"):
            patch.setattr(socket.socket, name, guarded(getattr(socket.socket, name)))
        yield


@pytest.fixture(autouse=True, scope="session")
def _commands_are_made_once() -> Iterator[None]:
    """Keep Click's commands, which Typer makes anew for each command line that it runs."""
    import typer.main

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", functools.cache(typer.main.get_command))
        yield


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A `HubServer` that the Hub's client takes for the Hub, with an empty cache and no login."""
    from support.hub import running_hub

    with running_hub(tmp_path / "cache", monkeypatch) as server:
        yield server


@pytest.fixture
def login(hub: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Log in to that Hub as somebody: name, and the rights that `User` has."""
    from huggingface_hub import constants
    from support.hub_server import User

    def log_in(name: str, **rights: Any) -> None:
        hub.tokens[f"hf_{name}"] = User(name, **rights)
        monkeypatch.setenv("HF_TOKEN", f"hf_{name}")
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_IMPLICIT_TOKEN", False)

    return log_in


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Tell the Hub's client from now on that there is no network."""
    from huggingface_hub import constants

    return lambda: monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings that lie beside a checkout, on machines that have them."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real recordings in {folder}")
    return folder


@pytest.fixture(scope="session")
def tabletop() -> Iterator[Any]:
    """The embedded simulator in this process, a `TabletopSimulator`: making it takes seconds."""
    from robomme_interference_data.errors import NoRendererError
    from robomme_interference_data.simulators import make_simulator

    try:
        made = make_simulator("tabletop")
    except NoRendererError as error:
        pytest.skip(str(error))
    with made:  # type: ignore[attr-defined]
        yield made


@pytest.fixture
def blind(tabletop: Any) -> Iterator[Any]:
    """That simulator without drawing, which is several times as fast."""
    tabletop.env.drawing = False
    yield tabletop
    tabletop.env.drawing = True


@pytest.fixture(scope="session")
def bare_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with numpy < 2 and nothing else."""
    folder = tmp_path_factory.mktemp("robomme") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    site = folder / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}"
    command = [sys.executable, "-m", "pip", "--no-input", "install", "--quiet", "--no-deps"]
    command += ["--no-compile", "--only-binary", ":all:"]
    command += ["--target", str(site / "site-packages"), "numpy<2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode != 0:
        pytest.skip(f"no package index gives numpy < 2: {done.stderr.strip()[-500:]}")
    return folder / "bin" / "python"


@pytest.fixture
def robomme_python(bare_python: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That interpreter with the stand-in, a package `robomme` with RoboMME's interface.

    It behaves badly, or ends an episode, where the episode's index asks for it.
    """
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests" / "support" / "robomme_stand_in"))
    monkeypatch.setenv("ROBOMME_PYTHON", str(bare_python))
    return bare_python


@pytest.fixture(scope="session")
def tiny_buffers() -> Path:
    """The golden buffer set: not to be written to. See `support/buffer_sets.py`."""
    from support.buffer_sets import GOLDEN

    return GOLDEN


@pytest.fixture(scope="session")
def executed_buffers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden buffer set with executions of its queries: not to be written to."""
    from support.buffer_sets import build, copy_buffer_set, plan_again

    from robomme_interference_data.build_dataset.sources.sample import SampleSource

    root = copy_buffer_set(tmp_path_factory.mktemp("executed") / "buffers")
    families = ("VideoRepick", "MoveCube", "PatternLock")
    build(root, "executions", SampleSource(size=32), families=families, split="test")
    plan_again(root)
    return root


@pytest.fixture
def own_buffers(tmp_path: Path) -> Path:
    """A copy of the golden buffer set, to be damaged."""
    from support.buffer_sets import copy_buffer_set

    return copy_buffer_set(tmp_path / "buffer_set")


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run the command line in this process; returns exit code, stdout and stderr."""

    from robomme_interference_data.cli.main import main

    def call(*arguments: object) -> tuple[int, str, str]:
        # `caplog` of later tests needs what the command line turns off.
        monkeypatch.setattr(logging.getLogger("robomme_interference_data"), "propagate", True)
        monkeypatch.setattr(sys, "argv", ["robomme-interference", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        code = ended.value.code
        return (code if isinstance(code, int) else 0), out, err

    return call
