"""Prepare a release, all but the steps that make it public: `make release VERSION=0.1.0`.

Checks that version, changelog, citation, commit and name agree; builds sdist and wheel into dist/;
uploads them to a package index on the loopback interface, installs the package from there by its
name, without pins, and uses it; builds the documentation and the images. Ends with the steps that
only the owner of the accounts can take.
"""

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import yaml
from bare_install import check_installs
from distribution import ROOT, build, configured_index

IMAGES = ("light", "full")
"""Targets of the Dockerfile."""

VERSION = re.compile(r"\d+\.\d+\.\d+(rc\d+)?")
"""As in 0.1.0 or 0.1.0rc1, in the form that indexes keep; its tag has a v in front."""

NOTES = "build/release-notes.md"
"""Where the changelog's newest section is written."""


def main() -> None:
    """Run every step; exit with an error at the first one that fails."""
    project = project_of(ROOT)
    version = sys.argv[1]
    if not VERSION.fullmatch(version):
        given = f"version {version!r}; expected three numbers" if version else "which version?"
        sys.exit(f"release: {given}. Run: make release VERSION={project['version']}")
    index = configured_index()
    problems = [*disagreements(ROOT, version), *name_problems(index, project, version)]
    if problems:
        sys.exit("\n".join(f"release: {problem}" for problem in problems))
    say("version, changelog, citation, commit, tag and name agree")

    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    build(ROOT / "dist")
    check_installs(ROOT / "dist", "highest")
    say("dist/ was uploaded to an index on loopback, installed from it by name, and used")

    subprocess.run(["make", "docs"], cwd=ROOT, check=True)
    make_images(project["name"], version)
    (ROOT / NOTES).write_text(newest_section(ROOT)[1], encoding="utf-8")
    print(*remaining(project["name"], version), sep="\n")


def project_of(root: Path) -> dict[str, Any]:
    """Return the table `project` of a checkout's pyproject.toml."""
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    project: dict[str, Any] = tomllib.loads(text)["project"]
    return project


def disagreements(root: Path, version: str) -> Iterator[str]:
    """Yield what in a checkout does not agree with a version, and what to do about it."""
    declared = project_of(root)["version"]
    if declared != version:
        yield f"pyproject.toml has version {declared}, not {version}: set `version`"
    cited = yaml.safe_load((root / "CITATION.cff").read_text(encoding="utf-8"))["version"]
    if str(cited) != version:
        yield f"CITATION.cff has version {cited}, not {version}: set `version`"
    newest, _ = newest_section(root)
    if newest.split()[0] != version:
        yield f"CHANGELOG.md begins with {newest}, not {version}: rename its first section"
    changed = git(root, "status", "--porcelain", check=True).splitlines()
    if changed:
        listed = ", ".join(line[3:] for line in changed[:5])
        yield f"{len(changed)} files are not committed ({listed}): commit or remove them"
    tagged = git(root, "rev-parse", "--verify", "--quiet", f"refs/tags/v{version}^{{commit}}")
    # On a tag that was pushed, the workflow `publish` runs this.
    if tagged and tagged != git(root, "rev-parse", "HEAD"):
        yield f"the tag v{version} is on another commit ({tagged[:8]}): raise the version"


def newest_section(root: Path) -> tuple[str, str]:
    """Return the heading and the text of the changelog's first section."""
    changelog = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    _, section, *_ = re.split(r"^## ", changelog, flags=re.MULTILINE)
    heading, _, text = section.partition("\n")
    return heading, text.strip() + "\n"


def git(root: Path, *arguments: str, check: bool = False) -> str:
    """Return what git prints; nothing, if it has no answer.

    With `check`, the release ends where git fails, which must not read as an answer.
    """
    command = ["git", "-C", str(root), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if check and done.returncode:
        sys.exit(f"release: {shlex.join(command)} fails: {done.stderr.strip()}")
    return done.stdout.rstrip("\n")


def name_problems(index: str, project: dict[str, Any], version: str) -> Iterator[str]:
    """Yield why a package index would not take this version under the project's name."""
    name = project["name"]
    try:
        answer = httpx.get(f"{index}/{name}/", follow_redirects=True, timeout=60)
    except httpx.HTTPError as error:
        yield f"the package index cannot be reached, so the name {name} may be taken: {error}"
        return
    if answer.status_code == httpx.codes.NOT_FOUND:
        return
    if answer.is_error:
        yield f"the package index answers {answer.status_code}: the name {name} may be taken"
    elif project["urls"]["Repository"] not in published_urls(index, name):
        yield f"the name {name} is taken on the package index: choose another in pyproject.toml"
    elif f"{name.replace('-', '_')}-{version}-" in answer.text:
        yield f"{name} {version} is on the package index: versions never change, raise it"


def published_urls(index: str, name: str) -> set[str]:
    """Return the addresses that the newest wheel of a name on an index states.

    Only of a wheel, because to read an sdist's metadata runs its code.
    """
    with tempfile.TemporaryDirectory(prefix="taken-") as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--only-binary", ":all:", "--index-url", index, "--dest", folder, name]
        subprocess.run(command, capture_output=True, check=False)
        for wheel in Path(folder).glob("*.whl"):
            with zipfile.ZipFile(wheel) as archive:
                [path] = [
                    name for name in archive.namelist() if name.endswith(".dist-info/METADATA")
                ]
                lines = archive.read(path).decode().splitlines()
            return {line.split(", ")[-1] for line in lines if line.startswith("Project-URL: ")}
    return set()


def make_images(name: str, version: str) -> None:
    """Build and start the images; without Docker, run the scripts that they are made by."""
    if not has_docker():
        say("no Docker here: the scripts that make the images run on this machine instead")
        for command in run_lines(ROOT / "Dockerfile"):
            subprocess.run(command, cwd=ROOT, check=True)
        return
    for target in IMAGES:
        tag = f"{name}:{version}-{target}"
        docker = ["docker", "build", "--target", target, "--tag", tag, str(ROOT)]
        subprocess.run(docker, check=True)
        subprocess.run(["docker", "run", "--rm", tag], check=True)  # it prints what works in it


def has_docker() -> bool:
    """Return whether Docker is installed and its service answers."""
    if shutil.which("docker") is None:
        return False
    return subprocess.run(["docker", "info"], capture_output=True, check=False).returncode == 0


def run_lines(dockerfile: Path) -> list[list[str]]:
    """Return the commands of a Dockerfile's RUN lines, as words."""
    text = dockerfile.read_text(encoding="utf-8")
    return [shlex.split(line) for line in re.findall(r"^RUN (.+)$", text, flags=re.MULTILINE)]


def remaining(name: str, version: str) -> list[str]:
    """Return the three steps that are left to a person."""
    images = " and ".join(f"{name}:{version}-{target}" for target in IMAGES)
    return [
        "What remains (docs/how-to/maintain.md):",
        f"1. git tag v{version} && git push origin v{version}, then approve the upload in Actions",
        f"2. push the images {images}, built where Docker runs, to a registry of yours",
        f"3. gh release create v{version} --title {version} --notes-file {NOTES}",
    ]


def say(text: str) -> None:
    """Print at once, so that lines and the commands' own output stay in order."""
    print(f"release: {text}", flush=True)


if __name__ == "__main__":
    main()
