"""What the package is made of: its project file, its folders, its files."""

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGE = "robomme_interference_data"
MAPPING: dict[str, str] = CONFIG["tool"]["setuptools"]["package-dir"]

HEAVY = ("torch", "lerobot", "h5py", "matplotlib", "datasets", "pandas", "mani_skill", "sapien")
HEAVY += ("ray", "transformers", "scipy", "jinja2", "gymnasium", "cv2")
"""Libraries that the light install does without."""


def module_files() -> dict[str, Path]:
    """All files of the package by their path in an installed copy."""
    found = {}
    for package, folder in MAPPING.items():
        for path in sorted((ROOT / folder).rglob("*")):
            relative = path.relative_to(ROOT / folder)
            if path.is_file() and "__pycache__" not in relative.parts:
                found[f"{package.replace('.', '/')}/{relative.as_posix()}"] = path
    return found


_LIST_MODULES = """
import sys
from pathlib import Path
for name, module in sys.modules.items():
    # An empty file makes a folder a package.
    if name.startswith("robomme_interference_data.") and Path(module.__file__).stat().st_size > 0:
        print(name.partition(".")[2])
"""


def imported_modules(code: str, folder: Path) -> list[str]:
    """Return the package's modules that code imports, run in a folder by a process of its own."""
    command = [sys.executable, "-c", f"{code}\n{_LIST_MODULES}"]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=400, check=True
    )
    return sorted(done.stdout.split())


def committable() -> list[str]:
    """Every file that is or could be committed."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()]
