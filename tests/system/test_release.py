"""`make release` notices what does not agree; what it builds images of, and what GitHub shows."""

import json
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from support.package import CONFIG, ROOT
from support.package_index import PackageIndex

PROJECT = CONFIG["project"]
NAME, VERSION = PROJECT["name"], PROJECT["version"]
STEM = NAME.replace("-", "_")


@pytest.fixture(scope="module")
def release() -> Iterator[ModuleType]:
    """The script, as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "scripts")
        import release as script

        yield script


# --- what must agree -----------------------------------------------------------------------------


def git(checkout: Path, *arguments: str) -> None:
    who = ("-c", "user.name=me", "-c", "user.email=me@example.com")
    subprocess.run(["git", "-C", checkout, *who, *arguments], capture_output=True, check=True)


def rewrite(path: Path, pattern: str, text: str) -> None:
    old = path.read_text(encoding="utf-8")
    new = re.sub(pattern, text, old, count=1, flags=re.MULTILINE)
    assert new != old
    path.write_text(new, encoding="utf-8")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout whose version, changelog and citation agree, committed."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    for name in ("pyproject.toml", "CITATION.cff"):
        (folder / name).write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
    text = f"# Changelog\n\n## {VERSION} (2026-12-01)\n\n- All.\n\n## 0.0.1\n\n- Some.\n"
    (folder / "CHANGELOG.md").write_text(text, encoding="utf-8")
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "All")
    return folder


def break_version(checkout: Path) -> None:
    rewrite(checkout / "pyproject.toml", r"^version = .*", 'version = "7.0"')


def break_citation(checkout: Path) -> None:
    rewrite(checkout / "CITATION.cff", r"^version: .*", "version: 7.0")


def break_changelog(checkout: Path) -> None:
    rewrite(checkout / "CHANGELOG.md", r"^## .*", "## Unreleased")


BROKEN = {"pyproject.toml": break_version, "CITATION.cff": break_citation}
BROKEN["CHANGELOG.md"] = break_changelog


def test_a_checkout_that_agrees_can_be_released(release: Any, checkout: Path) -> None:
    assert [*release.disagreements(checkout, VERSION)] == []
    git(checkout, "tag", f"v{VERSION}")  # as in the workflow, which runs on the tag
    assert [*release.disagreements(checkout, VERSION)] == []


@pytest.mark.parametrize("file", BROKEN)
def test_a_file_with_another_version_is_named(release: Any, checkout: Path, file: str) -> None:
    BROKEN[file](checkout)
    git(checkout, "commit", "--quiet", "--all", "--message", "Broken")
    [problem] = release.disagreements(checkout, VERSION)
    assert problem.startswith(file) and VERSION in problem


def test_what_is_not_committed_is_named(release: Any, checkout: Path) -> None:
    (checkout / "notes.txt").touch()
    [problem] = release.disagreements(checkout, VERSION)
    assert "notes.txt" in problem


def test_a_tag_is_never_moved(release: Any, checkout: Path) -> None:
    git(checkout, "tag", f"v{VERSION}")
    git(checkout, "commit", "--quiet", "--allow-empty", "--message", "Later")
    [problem] = release.disagreements(checkout, VERSION)
    assert f"tag v{VERSION}" in problem


def test_the_notes_are_the_changelogs_newest_section(release: Any, checkout: Path) -> None:
    assert release.newest_section(checkout) == (f"{VERSION} (2026-12-01)", "- All.\n")


@pytest.mark.parametrize("version", ["", "7.0.0", "7.0", f"v{VERSION}", f"{VERSION} "])
def test_the_program_ends_before_it_builds(version: str) -> None:
    """The index is not asked for the version's sake: nothing answers there."""
    own = {"PYTHONPATH": str(ROOT / "tests"), "UV_DEFAULT_INDEX": "http://127.0.0.1:9/simple"}
    command = [sys.executable, ROOT / "scripts" / "release.py", version]
    done = subprocess.run(
        command, env=os.environ | own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert all(line.startswith("release: ") for line in done.stderr.splitlines())
    agrees = version == "7.0.0"  # with how versions are written
    expected = "pyproject.toml has version" if agrees else f"make release VERSION={VERSION}"
    assert expected in done.stderr


# --- the name on the index -----------------------------------------------------------------------


@pytest.fixture
def index() -> Iterator[PackageIndex]:
    with PackageIndex().running() as server:
        yield server


def wheel(folder: Path, version: str, url: str) -> Path:
    """A wheel with the project's name, and its files' address."""
    path = folder / f"{STEM}-{version}-py3-none-any.whl"
    info = f"{STEM}-{version}.dist-info"
    lines = [
        "Metadata-Version: 2.4",
        f"Name: {NAME}",
        f"Version: {version}",
        f"Project-URL: Repository, {url}",
    ]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{info}/METADATA", "\n".join(lines))
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


def test_a_free_name_is_no_problem(release: Any, index: PackageIndex) -> None:
    assert [*release.name_problems(index.simple, PROJECT, VERSION)] == []
    assert index.requests == [f"GET /simple/{NAME}/"]


@pytest.mark.parametrize(
    ("published", "ours", "says"),
    [("0.0.1", True, None), (VERSION, True, "versions never change"), ("0.0.1", False, "is taken")],
)
def test_a_name_is_taken_by_others_and_a_version_by_us(
    release: Any, index: PackageIndex, tmp_path: Path, published: str, ours: bool, says: str | None
) -> None:
    url = PROJECT["urls"]["Repository"] if ours else "https://example.com/somebody-else"
    index.add(NAME, "somebody", wheel(tmp_path, published, url))
    problems = [*release.name_problems(index.simple, PROJECT, VERSION)]
    assert len(problems) == (says is not None)
    assert says is None or says in problems[0]


def test_the_code_of_an_sdist_is_not_run(release: Any, index: PackageIndex, tmp_path: Path) -> None:
    sdist = tmp_path / f"{STEM}-0.0.1.tar.gz"
    sdist.touch()
    index.add(NAME, "somebody", sdist)
    [problem] = release.name_problems(index.simple, PROJECT, VERSION)
    assert "is taken" in problem
    assert index.requests.count(f"GET /files/{NAME}/{sdist.name}") == 0


def test_a_name_is_not_free_because_nothing_answers(release: Any, index: PackageIndex) -> None:
    index.down = True
    for address in (index.simple, "http://127.0.0.1:9/simple"):
        [problem] = release.name_problems(address, PROJECT, VERSION)
        assert "may be taken" in problem


# --- images --------------------------------------------------------------------------------------

DOCKERFILE = ROOT / "Dockerfile"
SET_UP = ("scripts/setup.sh", "scripts/system_packages.sh")
"""Scripts that `make setup` runs, and with it every step of CI, in the container of `full`."""


def programs(release: Any) -> list[str]:
    return [words[0] for words in release.run_lines(DOCKERFILE)]


def test_every_step_of_an_image_is_a_script_that_is_run_without_docker(release: Any) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert {*programs(release)} == {*SET_UP, "scripts/install_light.sh"}
    assert all(os.access(ROOT / program, os.X_OK) for program in programs(release))
    assert all(f"\t@{program}" in makefile for program in SET_UP)
    targets = re.findall(r"^FROM \S+ AS (\S+)$", DOCKERFILE.read_text("utf-8"), flags=re.MULTILINE)
    assert {*release.IMAGES} <= {*targets}


@pytest.mark.slow
def test_the_step_of_the_light_image_runs(release: Any, tmp_path: Path) -> None:
    [[program, _]] = [line for line in release.run_lines(DOCKERFILE) if line[0] not in SET_UP]
    command = [ROOT / program, tmp_path / "light"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    if "No matching distribution" in done.stderr:
        pytest.skip("no package index answers")
    assert done.returncode == 0, done.stderr
    assert not [*tmp_path.glob("light/lib/python*/site-packages/torch")]


def test_the_light_installation_replaces_no_folder_of_yours(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("a year of work")
    command = [ROOT / "scripts" / "install_light.sh", "mine"]  # as seen from where it is run
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and str(tmp_path / "mine") in done.stderr
    assert (tmp_path / "mine" / "thesis.txt").exists()


def test_images_are_built_where_docker_answers(
    release: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    docker = tmp_path / "docker"
    docker.write_text(f'#!/bin/sh\necho "$1 $2 $3 $4 $5" >> {tmp_path}/calls\n')
    docker.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    release.make_images("name", "1.0.0")
    assert (tmp_path / "calls").read_text().splitlines()[1:] == [
        "build --target light --tag name:1.0.0-light",
        "run --rm name:1.0.0-light  ",
        "build --target full --tag name:1.0.0-full",
        "run --rm name:1.0.0-full  ",
    ]


def test_without_docker_the_scripts_run_instead(
    release: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "Dockerfile").write_text("FROM x AS light\nRUN touch one\nRUN touch 'two words'\n")
    monkeypatch.setattr(release, "ROOT", tmp_path)
    monkeypatch.setattr(release, "has_docker", lambda: False)
    release.make_images("name", "1.0.0")
    assert {path.name for path in tmp_path.iterdir()} == {"Dockerfile", "one", "two words"}
    assert "no Docker here" in capsys.readouterr().out


def test_images_get_no_file_that_git_ignores() -> None:
    def patterns(name: str) -> list[str]:
        lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
        return [line for line in lines if not line.startswith("#")]

    # Without a slash before its end git ignores it in every folder, Docker only at the top.
    expected = [
        f"**/{name}" if "/" not in name.rstrip("/") else name.removeprefix("/")
        for name in patterns(".gitignore")
    ]
    assert patterns(".dockerignore") == expected


def test_everybody_develops_in_the_same_image() -> None:
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text("utf-8"))
    ci = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text("utf-8"))
    assert container["image"] == ci["jobs"]["checks"]["container"]
    assert f"\nFROM {container['image']} AS full\n" in DOCKERFILE.read_text("utf-8")
    assert container["postCreateCommand"] == "make setup"


# --- what GitHub shows ---------------------------------------------------------------------------

FORMS = [form for form in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if form.stem != "config"]


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_a_form_is_one_that_github_shows(path: Path) -> None:
    """By GitHub's syntax of issue forms: otherwise it shows none."""
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {*form} <= {"name", "description", "labels", "body"}
    assert form["name"] and form["description"]
    identifiers = [field["id"] for field in form["body"]]
    assert len({*identifiers}) == len(identifiers)
    for field in form["body"]:
        assert {*field} <= {"type", "id", "attributes", "validations"}
        assert field["type"] in ("input", "textarea")
        assert {*field["attributes"]} <= {"label", "description", "placeholder", "render"}
        assert field["attributes"]["label"]
    assert any(field.get("validations") == {"required": True} for field in form["body"])


def test_a_vulnerability_is_reported_to_this_repository_in_private() -> None:
    repository = PROJECT["urls"]["Repository"]
    policy = (ROOT / ".github/SECURITY.md").read_text(encoding="utf-8")
    assert f"]({repository}/security/advisories/new)" in policy
    config = yaml.safe_load((ROOT / ".github/ISSUE_TEMPLATE/config.yml").read_text("utf-8"))
    assert config["blank_issues_enabled"] is False
    assert [link["url"] for link in config["contact_links"]] == [f"{repository}/security/policy"]


def test_the_readmes_badges_lead_to_files_of_this_repository() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    owner_and_name = PROJECT["urls"]["Repository"].removeprefix("https://github.com/")
    workflows = re.findall(rf"{owner_and_name}/actions/workflows/([\w.]+)", text)
    notebooks = re.findall(rf"{owner_and_name}/blob/main/(\S+?)\)", text)
    assert workflows and notebooks
    files = [*(f".github/workflows/{name}" for name in workflows), *notebooks]
    assert [name for name in files if not (ROOT / name).is_file()] == []
