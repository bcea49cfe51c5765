"""Copies of published buffer sets: resumed, widened, and what holds of a copy of a part."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import runs, worlds
from support.buffer_sets import GOLDEN, copy_buffer_set
from support.hub import BUFFER_SET, push_buffer_set, running_hub
from support.hub_server import HubServer
from support.tabletop import TABLETOP

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.data.fetch import fetch
from robomme_interference_data.data.fetch_plan import FetchConfig, plan_fetch
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.storage.files import all_files, sha256_file, write_json

Run = Callable[..., tuple[int, str, str]]
PART = ("--families", "MoveCube", "--conditions", "k0,k1", "--cameras", "front")
RECORD = "manifests/fetched.json"


@pytest.fixture
def published(hub: HubServer, tmp_path: Path) -> Iterator[HubServer]:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    yield hub


@pytest.fixture(scope="module")
def fetched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the buffers of one query under two conditions, seen by one camera."""
    folder = tmp_path_factory.mktemp("fetched")
    with pytest.MonkeyPatch.context() as patch, running_hub(folder / "cache", patch) as server:
        push_buffer_set(server, GOLDEN, folder / "work")
        config = FetchConfig(families=("MoveCube",), conditions=("k0", "k1"), cameras=("front",))
        fetch(plan_fetch(load_buffer_set(BUFFER_SET), config, folder / "part"), folder / "part")
    return folder / "part"


@pytest.fixture
def part(fetched: Path, tmp_path: Path) -> Path:
    """That copy as a folder of the test's own."""
    return copy_buffer_set(tmp_path / "part", fetched)


def digests(folder: Path) -> dict[str, str]:
    return {path: sha256_file(folder / path) for path in all_files(folder)}


def test_a_part_has_the_buffers_that_were_fetched(part: Path) -> None:
    buffer_set = load_buffer_set(part)
    whole = load_buffer_set(GOLDEN)
    assert [str(episode) for episode in buffer_set.episode_ids] == ["MoveCube/test/0"]
    assert buffer_set.conditions == ("no-history", "k0", "k1")
    assert buffer_set.families == ("MoveCube",)
    assert buffer_set.cameras == ("front",)
    assert len(buffer_set) == 3 < len(whole)
    assert [one.condition for one in buffer_set.manifests()] == ["no-history", "k0", "k1"]
    assert len([*buffer_set.planned_manifests()]) == len(whole)
    assert buffer_set.revision == whole.revision
    found, expected = (one.load("MoveCube/test/0", "k1") for one in (buffer_set, whole))
    assert np.array_equal(found.frames("front"), expected.frames("front"))
    assert np.array_equal(found.states, expected.states)


@pytest.mark.parametrize(
    ("episode", "condition", "options"),
    [
        ("MoveCube/test/0", "k7", "--conditions k7"),
        ("VideoRepick/test/0", "k0", "--families VideoRepick --episodes 0 --conditions k0"),
    ],
)
def test_what_a_part_lacks_is_an_error_with_the_command(
    part: Path, episode: str, condition: str, options: str
) -> None:
    buffer_set = load_buffer_set(part)
    with pytest.raises(MissingFileError) as caught:
        buffer_set.load(episode, condition)
    location = buffer_set.copy.record.location  # type: ignore[union-attr]
    assert caught.value.command == f"fetch {location} --to {part} {options}"
    with pytest.raises(UnknownNameError):
        buffer_set.load("MoveCube/test/9", "k0")


def test_the_default_camera_of_a_part_is_one_that_is_there(
    published: HubServer, run: Run, tmp_path: Path
) -> None:
    options = ("--families", "MoveCube", "--conditions", "k0", "--cameras", "wrist")
    assert run("fetch", BUFFER_SET, *options, "--to", tmp_path / "part")[0] == 0
    out = tmp_path / "strip.png"
    assert run("show", tmp_path / "part", "MoveCube/test/0", "k0", "--out", out)[0] == 0
    code, _, err = run("fetch", BUFFER_SET, "--cameras", "side")
    assert code == 1 and "--cameras" in err


def test_verify_says_which_frames_it_cannot_decode(part: Path, run: Run) -> None:
    """Hashes are of all cameras; the part has one of two."""
    buffer_set = load_buffer_set(part)
    copy, units = buffer_set.copy, buffer_set.datasets["distractors"]
    assert copy is not None
    held = [buffer_set.query("MoveCube/test/0").record.length]
    held += [unit.length for unit in units.records() if copy.holds(units, unit.episode_index)]
    code, out, err = run("verify", part, "--json")
    assert code == 0 and json.loads(out)["frames_not_decoded"] == sum(held)
    assert "0/0" not in err
    assert "Not decoded" in run("verify", part)[2]


def test_a_camera_that_was_not_fetched(part: Path) -> None:
    buffer_set = load_buffer_set(part)
    with pytest.raises(MissingFileError) as caught:
        buffer_set.load("MoveCube/test/0", "k0").frames("wrist")
    assert caught.value.command == buffer_set.copy.refetch  # type: ignore[union-attr]


@pytest.mark.slow
def test_commands_work_on_a_part(part: Path, run: Run, tmp_path: Path) -> None:
    code, out, err = run("list", part, "--json")
    assert code == 0 and [row["condition"] for row in json.loads(out)] == ["no-history", "k0", "k1"]
    assert "holds 3 of the 15 buffers" in err and "fetch" in err
    assert run("verify", part)[0] == 0
    assert run("show", part, "MoveCube/test/0", "k1", "--out", tmp_path / "strip.png")[0] == 0
    assert run("show", part, "MoveCube/test/0", "k1", "--html", tmp_path / "page.html")[0] == 0
    assert run("ceiling", part)[0] == run("ceiling", GOLDEN)[0]
    code, _, err = run("show", part, "MoveCube/test/0", "k7")
    assert code == 1 and f"--to {part} --conditions k7" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("publish {} --repo-id someone/other --dry-run", "fetch"),
        ("index {}", "fetch"),
        ("build {} --only manifests --conditions before-k1", "build BUFFER_SET --demonstrations"),
        ("list {} --conditions before-k1", "build BUFFER_SET --demonstrations"),
        ("build {} --only questions", "build BUFFER_SET --demonstrations"),
    ],
)
def test_a_part_is_neither_changed_nor_published(
    part: Path, run: Run, words: str, command: str
) -> None:
    before = digests(part)
    code, _, err = run(*words.format(part).split())
    assert code == 1 and f"\nRun: robomme-interference {command} " in err
    assert digests(part) == before


def test_questions_that_were_not_fetched(hub: HubServer, run: Run, tmp_path: Path) -> None:
    push_buffer_set(hub, TABLETOP, tmp_path / "work")
    words = ("--families", "MoveCube", "--conditions", "k0")
    assert run("fetch", BUFFER_SET, *words, "--to", tmp_path / "part")[0] == 0
    part = load_buffer_set(tmp_path / "part")
    with pytest.raises(MissingFileError) as caught:
        read_questions(part)
    assert caught.value.command == f"{part.copy.refetch} --questions"  # type: ignore[union-attr]
    assert run("fetch", BUFFER_SET, *words, "--questions", "--to", tmp_path / "part")[0] == 0
    assert {*load_buffer_set(tmp_path / "part").episode_ids} <= {*read_questions(part)}


def test_a_run_on_a_part_plays_what_it_holds(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(worlds.BUFFER_SET, str(GOLDEN))
    fields: dict[str, Any] = {"buffer_set": part, "families": (), "episodes": None}
    runs.run(tmp_path / "run", conditions=(), **fields)
    rows = runs.finished_rows(tmp_path / "run")
    assert [(row["family"], row["episode"], row["condition"]) for row in rows] == [
        ("MoveCube", 0, condition) for condition in ("no-history", "k0", "k1")
    ]


def test_a_part_is_verified(part: Path) -> None:
    counted: dict[str, int] = {"done": 0, "all": 0}
    shown: Any = SimpleNamespace(
        start=lambda text, frames: counted.update(all=frames),
        advance=lambda frames: counted.update(done=counted["done"] + frames),
    )
    assert [*verify_buffer_set(load_buffer_set(part), progress=shown)] == []
    assert counted["done"] == counted["all"]
    video = next(path for path in all_files(part) if path.endswith(".mp4"))
    (part / video).unlink()
    assert [one.what for one in verify_buffer_set(load_buffer_set(part)) if video in one.where] == [
        "is missing"
    ]


def test_a_file_that_the_record_does_not_list_is_a_violation(part: Path) -> None:
    """Its buffers cannot be loaded, though all files are right."""
    path = part / RECORD
    record = json.loads(path.read_text())
    video = next(name for name in record["files"] if name.endswith(".mp4"))
    path.write_text(json.dumps(record | {"files": [f for f in record["files"] if f != video]}))
    found = [*verify_buffer_set(load_buffer_set(part), decode=False)]
    assert [(one.where, one.what) for one in found if "listed in" in one.what] == [
        (video, "is not listed in manifests/fetched.json")
    ]


def test_a_copy_is_repeated_and_widened(
    published: HubServer, part: Path, run: Run, tmp_path: Path
) -> None:
    before = digests(part)
    assert run("fetch", BUFFER_SET, *PART, "--to", part)[0] == 0
    assert digests(part) == before
    assert run("fetch", BUFFER_SET, "--conditions", "k7", "--to", part)[0] == 0
    widened = load_buffer_set(part)
    assert "k7" in widened.conditions and len(widened.episode_ids) == 3
    assert widened.cameras == ("front", "wrist")
    assert run("fetch", BUFFER_SET, "--to", part)[0] == 0
    assert run("fetch", BUFFER_SET, "--to", tmp_path / "whole")[0] == 0
    assert digests(part) == digests(tmp_path / "whole")
    assert [*verify_buffer_set(load_buffer_set(part))] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "part", "whole", "work"]


def test_a_copy_in_the_current_folder(
    published: HubServer, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert run("fetch", BUFFER_SET, *PART, "--to", ".")[0] == 0
    assert run("fetch", BUFFER_SET, *PART, "--to", ".")[0] == 0
    assert run("verify", ".")[0] == 0


def test_a_damaged_file_of_a_copy_is_replaced(published: HubServer, part: Path, run: Run) -> None:
    video = part / next(path for path in all_files(part) if path.endswith(".mp4"))
    before = video.read_bytes()
    video.write_bytes(before[:-1] + b"x")
    assert run("fetch", BUFFER_SET, *PART, "--to", part)[0] == 0
    assert video.read_bytes() == before


def test_a_folder_that_is_no_copy_is_not_written_to(
    published: HubServer, run: Run, tmp_path: Path, own_buffers: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for folder in (tmp_path / "mine", own_buffers, tmp_path / "mine" / "notes.txt"):
        before = digests(folder) if folder.is_dir() else None
        code, _, err = run("fetch", BUFFER_SET, "--to", folder)
        assert code == 1 and InvalidOptionError.__name__ not in err
        assert "to fetch" not in err  # the folder is checked before anything is planned
        if before is not None:
            assert digests(folder) == before
    code, _, _ = run("fetch", BUFFER_SET, "--to", own_buffers / "demonstrations" / "copy")
    assert code == 1


def test_a_copy_of_another_buffer_set_is_not_mixed(
    published: HubServer, run: Run, tmp_path: Path, part: Path
) -> None:
    other = copy_buffer_set(tmp_path / "other")
    push_buffer_set(published, other, tmp_path / "other-work", "someone/else")
    header = tmp_path / "other-work" / "manifests" / "manifest.json"
    write_json(header, json.loads(header.read_text()) | {"seed": 7})
    published.push("datasets/someone/else", tmp_path / "other-work")
    for _ in range(2):
        before = digests(part)
        code, _, err = run("fetch", "someone/else", *PART, "--to", part)
        assert code == 1 and f"fetch {BUFFER_SET}@" in err
        assert digests(part) == before
        (part / "manifests" / "manifest.json").unlink(missing_ok=True)  # as after an interruption


# --- files that the buffer set does not list ------------------------------------------------------


@pytest.mark.slow
def test_only_listed_files_are_fetched(hub: HubServer, run: Run, tmp_path: Path) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    planted = ("multiprocessing.py", "meta/more.py", "manifests/x.py", "data/x.py", "sub/x.py")
    for path in planted:
        (tmp_path / "work" / path).parent.mkdir(exist_ok=True)
        (tmp_path / "work" / path).write_text("raise SystemExit('planted')")
    (tmp_path / "work" / "README.md").write_text("# a card")
    hub.push(f"datasets/{BUFFER_SET}", tmp_path / "work")
    code, _, err = run("fetch", BUFFER_SET, "--to", tmp_path / "copy")
    assert code == 0 and "5 files" in err and "data/x.py" in err
    copied = all_files(tmp_path / "copy")
    assert not {*planted} & {*copied} and "README.md" in copied
    assert [*verify_buffer_set(load_buffer_set(tmp_path / "copy"))] == []


def relist(work: Path, path: str, sha256: str) -> None:
    """Change the units' list of digests, and the digests that lead to it."""
    sums = work / "meta" / "SHA256SUMS"
    kept = [line for line in sums.read_text().splitlines() if not line.endswith(f"  {path}")]
    sums.write_text("\n".join(sorted([*kept, f"{sha256}  {path}"])) + "\n")
    identity = work / "meta" / "interference.json"
    write_json(identity, json.loads(identity.read_text()) | {"sums": sha256_file(sums)})
    header = json.loads((work / "manifests" / "manifest.json").read_text())
    header["datasets"]["distractors"]["identity"] = sha256_file(identity)
    write_json(work / "manifests" / "manifest.json", header)


@pytest.mark.slow
def test_a_list_cannot_name_files_outside_the_dataset(
    hub: HubServer, run: Run, tmp_path: Path
) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    data = b"raise SystemExit('planted')"
    (tmp_path / "work" / "multiprocessing.py").write_bytes(data)
    relist(tmp_path / "work", "multiprocessing.py", hashlib.sha256(data).hexdigest())
    hub.push(f"datasets/{BUFFER_SET}", tmp_path / "work")
    code, _, err = run("fetch", BUFFER_SET, "--to", tmp_path / "copy")
    assert code == 1 and "multiprocessing.py" in err and not (tmp_path / "copy").exists()
    violations = verify_buffer_set(load_buffer_set(BUFFER_SET))
    assert "multiprocessing.py" in {one.where for one in violations}


def test_a_file_that_differs_from_its_list_is_not_copied(
    hub: HubServer, run: Run, tmp_path: Path
) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    relist(tmp_path / "work", "meta/stats.json", "0" * 64)
    hub.push(f"datasets/{BUFFER_SET}", tmp_path / "work")
    code, _, err = run("fetch", BUFFER_SET, "--to", tmp_path / "copy")
    assert code == 1 and "meta/stats.json" in err and not (tmp_path / "copy").exists()


def test_rows_that_differ_from_their_header_are_not_copied(
    hub: HubServer, run: Run, tmp_path: Path
) -> None:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    header = tmp_path / "work" / "manifests" / "manifest.json"
    write_json(header, json.loads(header.read_text()) | {"rows": "0" * 64})
    hub.push(f"datasets/{BUFFER_SET}", tmp_path / "work")
    code, _, err = run("fetch", BUFFER_SET, "--to", tmp_path / "copy")
    assert code == 1 and "manifests/buffers.parquet" in err and not (tmp_path / "copy").exists()


# --- the record -----------------------------------------------------------------------------------


def test_the_record_of_a_copy(part: Path) -> None:
    record = json.loads((part / RECORD).read_text())
    assert sorted(record) == ["files", "format_version", "location"]
    assert record["format_version"] == 1 and record["location"].startswith(f"{BUFFER_SET}@")
    assert record["files"] == sorted({*all_files(part)} - {RECORD})


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"files": 7}, {"format_version": 2}, {"more": 1}])
def test_a_damaged_record(part: Path, change: dict[str, Any]) -> None:
    write_json(part / RECORD, json.loads((part / RECORD).read_text()) | change)
    with pytest.raises(FormatError):
        load_buffer_set(part)


def test_an_interrupted_copy_names_the_command(part: Path) -> None:
    (part / "manifests" / "manifest.json").unlink()
    with pytest.raises(MissingFileError) as caught:
        load_buffer_set(part)
    assert caught.value.command is not None
    assert caught.value.command.startswith(f"fetch {BUFFER_SET}@")
    shutil.rmtree(part / "manifests")
    with pytest.raises(MissingFileError) as caught:
        load_buffer_set(part)
    assert HashMismatchError.__name__ not in str(caught.value)
