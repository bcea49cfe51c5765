"""The software Vulkan driver is installed with the machine's own package sources, or not at all."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = ROOT / "scripts" / "software_vulkan.py"
    spec = importlib.util.spec_from_file_location("software_vulkan", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


DEB822 = """\
# The archive.
Types: deb deb-src
URIs: file:///mirror/debian
# Not this one.
Suites: bookworm bookworm-updates
Components: main contrib
Signed-By: /keys/debian-archive-keyring.gpg

Types: deb
URIs: file:///mirror/debian-security
Suites: bookworm-security
Components: main
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
URIs: file:///mirror/debian
Suites:
 bookworm
 bookworm-updates
Components: main
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 .
 mQINBF
 -----END PGP PUBLIC KEY BLOCK-----
"""
LIST = "deb file:///mirror/debian bookworm main  # the archive"
SIGNED_LIST = "deb [arch=amd64 signed-by=/keys/debian-archive-keyring.gpg] file:///m/ bookworm main"
THIRD_PARTY = "deb [signed-by=/keys/other.gpg] file:///other bookworm main"


@pytest.mark.parametrize(
    ("files", "added", "text"),
    [
        ({"sources.list.d/debian.sources": DEB822}, ".sources", DEB822_BACKPORTS),
        (
            {"sources.list.d/debian.sources": INLINE_KEY},
            ".sources",
            INLINE_KEY.replace("\n bookworm\n bookworm-updates", " bookworm-backports"),
        ),
        (
            {"sources.list": f"# local\n{LIST}\n"},
            ".list",
            "deb file:///mirror/debian bookworm-backports main\n",
        ),
        (
            {"sources.list": THIRD_PARTY, "sources.list.d/archive.list": SIGNED_LIST},
            ".list",
            SIGNED_LIST.replace("bookworm", "bookworm-backports") + "\n",
        ),
        # Already there: nothing is added.
        ({"sources.list": LIST, "sources.list.d/b.sources": DEB822_BACKPORTS}, None, None),
    ],
    ids=["deb822", "deb822 with its key inside", "list", "third party", "already there"],
)
@pytest.mark.parametrize("works", [True, False])
def test_the_backports_have_the_mirror_and_key_of_the_release(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    script: ModuleType,
    files: dict[str, str],
    added: str | None,
    text: str | None,
    works: bool,
) -> None:
    (tmp_path / "sources.list.d").mkdir()
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    commands: list[str] = []
    seen: list[str] = []

    def run(*command: str) -> str | None:
        commands.append(command[-1])
        folder = tmp_path / "sources.list.d"
        seen.extend(f"{path.name}\n{path.read_text()}" for path in folder.glob("*-backports.*"))
        return None if works else f"{command[-1]} failed"

    monkeypatch.setattr(script, "run", run)
    release = {"VERSION_CODENAME": "bookworm"}
    monkeypatch.setattr(script.platform, "freedesktop_os_release", lambda: release)

    assert script.install(tmp_path) == (None if works else "update failed")
    assert commands == ["update", "mesa-vulkan-drivers"]
    new = [] if added is None else [f"bookworm-backports{added}\n{text}"]
    assert seen == new * 2
    # A failed attempt leaves the package sources as they were.
    kept = [path.name for path in (tmp_path / "sources.list.d").glob("*-backports.*")]
    assert len(kept) == (len(new) if works else 0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# " + LIST,
        LIST.replace("bookworm", "bookworm-security"),
        LIST.replace("main", "contrib"),
        LIST.replace("deb ", "deb-src "),
    ],
)
def test_without_a_fitting_package_source_it_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: ModuleType, text: str
) -> None:
    (tmp_path / "sources.list").write_text(text, encoding="utf-8")
    release = {"VERSION_CODENAME": "bookworm"}
    monkeypatch.setattr(script.platform, "freedesktop_os_release", lambda: release)
    assert script.install(tmp_path) == f"{tmp_path} has no entry for bookworm main"


def test_a_switched_off_paragraph_does_not_count(tmp_path: Path, script: ModuleType) -> None:
    (tmp_path / "sources.list.d").mkdir()
    path = tmp_path / "sources.list.d" / "debian.sources"
    path.write_text("Enabled: no\n" + DEB822, encoding="utf-8")
    assert list(script.entries(tmp_path, "bookworm")) == []
    path.write_text("Enabled: yes\n" + DEB822, encoding="utf-8")
    assert len(list(script.entries(tmp_path, "bookworm"))) == 1


@pytest.mark.parametrize(
    ("renders", "apt", "user", "problem", "said"),
    [
        ([True], "apt-get", 0, None, ""),
        ([False], None, 0, None, "install the Vulkan driver of your GPU"),
        ([False], "apt-get", 1000, None, "run: sudo make vulkan"),
        ([False, True], "apt-get", 0, None, "installing Mesa's software Vulkan driver ..."),
        ([False, False], "apt-get", 0, None, "the Mesa that apt installs is too old"),
        ([False], "apt-get", 0, "E: no mirror", "failed: E: no mirror"),
    ],
)
def test_set_up_goes_on_whatever_happens_to_vulkan(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    script: ModuleType,
    renders: list[bool],
    apt: str | None,
    user: int,
    problem: str | None,
    said: str,
) -> None:
    answers = iter(renders)
    monkeypatch.setattr(script.sys, "platform", "linux")
    monkeypatch.setattr(script, "can_render", lambda: next(answers))
    monkeypatch.setattr(script.shutil, "which", lambda name: apt)
    monkeypatch.setattr(script.os, "geteuid", lambda: user)
    monkeypatch.setattr(script, "install", lambda folder: problem)
    script.main()
    out, err = capsys.readouterr()
    assert out == ""
    assert next(answers, None) is None
    assert said in err.splitlines()[-1] if said else err == ""


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        ("echo fine", None),
        ("echo one; echo two >&2; exit 3", "two"),
        ("echo one; echo 'E: cause'; echo 'E: consequence'; exit 3", "E: cause"),
        ("exit 3", "bash exited with 3"),
    ],
)
def test_a_failed_command_gives_one_line(
    script: ModuleType, command: str, problem: str | None
) -> None:
    assert script.run("bash", "-c", command) == problem
