"""Repositories as a Hub keeps them: commits, branches, tags, trees and large files. No network."""

import base64
import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePosixPath
from typing import Any

LARGE_SUFFIXES = (".arrow", ".bin", ".jpg", ".mp4", ".npy", ".npz", ".parquet", ".png", ".zip")
LARGE_BYTES = 10_000_000
"""What the Hub keeps as large files: such names, and what is bigger than that."""

GITATTRIBUTES = b"".join(
    b"*%b filter=lfs diff=lfs merge=lfs -text\n" % suffix.encode() for suffix in LARGE_SUFFIXES
)
"""The Hub's own file: its first commit holds nothing else."""

DATE = "2026-01-01T00:00:00.000Z"


class Refused(Exception):
    """A request that is answered with an error: its status, `X-Error-Code` and message."""

    def __init__(self, status: int, code: str, message: str, commit: str = ""):
        super().__init__(message)
        self.status = status
        self.code = code
        self.commit = commit


@dataclass(frozen=True)
class Blob:
    """A file's content; a large one lies in the store, and git has a pointer to it."""

    data: bytes = field(repr=False)
    large: bool

    @classmethod
    def of(cls, path: str, data: bytes) -> "Blob":
        return cls(data, is_large(path, len(data)))

    @cached_property
    def sha256(self) -> str:
        return hashlib.sha256(self.data).hexdigest()

    @cached_property
    def pointer(self) -> bytes:
        lines = "version https://git-lfs.github.com/spec/v1", f"oid sha256:{self.sha256}"
        return "\n".join((*lines, f"size {len(self.data)}", "")).encode()

    @cached_property
    def oid(self) -> str:
        """The object id that git gives what it keeps."""
        kept = self.pointer if self.large else self.data
        return hashlib.sha1(b"blob %d\0%b" % (len(kept), kept)).hexdigest()

    @property
    def etag(self) -> str:
        return self.sha256 if self.large else self.oid

    def entry(self, path: str) -> dict[str, Any]:
        entry = {"type": "file", "path": path, "size": len(self.data), "oid": self.oid}
        if self.large:
            size = {"size": len(self.data), "pointerSize": len(self.pointer)}
            entry["lfs"] = {"oid": self.sha256, **size}
        return entry


@dataclass(frozen=True)
class Commit:
    """All files at one point of a repository's history."""

    oid: str
    parent: str | None
    title: str
    files: dict[str, Blob] = field(repr=False)

    def entries(self, folder: str = "", recursive: bool = True) -> list[dict[str, Any]]:
        """Return the files and folders under a folder, as `tree` tells them."""
        below = f"{folder}/" if folder else ""
        files = {path: blob for path, blob in self.files.items() if path.startswith(below)}
        found = {path: blob.entry(path) for path, blob in files.items()}
        for path in files:
            for parent in map(str, PurePosixPath(path).parents):
                if parent != "." and parent.startswith(below) and parent not in found:
                    oid = hashlib.sha1(f"{self.oid} {parent}".encode()).hexdigest()
                    found[parent] = {"type": "directory", "path": parent, "size": 0, "oid": oid}
        if not files and folder:
            raise Refused(404, "EntryNotFound", f"{folder} does not exist", self.oid)
        deep = len(PurePosixPath(folder).parts) + 1
        return [
            entry
            for path, entry in sorted(found.items())
            if recursive or len(PurePosixPath(path).parts) == deep
        ]

    def file(self, path: str) -> Blob:
        if path not in self.files:
            raise Refused(404, "EntryNotFound", "Entry not found", self.oid)
        return self.files[path]


class Repository:
    """One repository.

    Attributes:
        name: Such as `datasets/someone/small`, or `someone/model`.
        private: Whether only its owner may know of it.
        commits: All commits by hash.
        branches, tags: Hash of the commit by name.
        store: Large files by SHA-256, whether a commit holds them or not.
    """

    def __init__(self, name: str, private: bool = False):
        self.name = name
        self.private = private
        self.commits: dict[str, Commit] = {}
        self.branches: dict[str, str] = {}
        self.tags: dict[str, str] = {}
        self.store: dict[str, bytes] = {}

    @property
    def id(self) -> str:
        return self.name.removeprefix("datasets/")

    @property
    def owner(self) -> str:
        return self.id.split("/")[0]

    def find(self, revision: str = "main") -> Commit:
        """Return the commit that a branch, tag or hash stands for."""
        oid = self.branches.get(revision) or self.tags.get(revision)
        if oid is None and len(revision) >= 7:
            oid = next((one for one in self.commits if one.startswith(revision)), None)
        if oid is None:
            raise Refused(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return self.commits[oid]

    def add(self, files: dict[str, Blob], title: str, branch: str = "main") -> Commit:
        """Make a commit that holds these files, and let a branch point to it."""
        parent = self.branches.get(branch)
        sums = {path: blob.oid for path, blob in files.items()}
        told = json.dumps([self.name, parent, title, sums], sort_keys=True)
        oid = hashlib.sha1(told.encode()).hexdigest()
        self.store |= {blob.sha256: blob.data for blob in files.values() if blob.large}
        self.commits[oid] = Commit(oid, parent, title, files)
        self.branches[branch] = oid
        return self.commits[oid]

    def commit(self, branch: str, lines: Iterable[bytes]) -> Commit:
        """Make the commit that a body of one JSON object a line asks for."""
        head = self.find(branch)
        files, title = dict(head.files), ""
        for key, value in ((item["key"], item["value"]) for item in map(json.loads, lines)):
            path = value.get("path", "").rstrip("/")
            if key == "header":
                title = value["summary"]
                if value.get("parentCommit", head.oid) != head.oid:
                    what = "A commit has happened since. Please refresh and try again."
                    raise Refused(412, "", what)
            elif key == "file":
                files[path] = Blob(base64.b64decode(value["content"]), large=False)
            elif key == "lfsFile":
                if value["oid"] not in self.store:
                    raise Refused(400, "", f"{path} points to a large file that does not exist")
                files[path] = Blob(self.store[value["oid"]], large=True)
            else:
                gone = {one for one in files if one == path or one.startswith(path + "/")}
                if not gone or (key == "deletedFile") != (gone == {path}):
                    raise Refused(404, "EntryNotFound", "A file with this name doesn't exist")
                files = {one: blob for one, blob in files.items() if one not in gone}
        return self.add(files, title, branch)

    def tag(self, name: str, revision: str = "main") -> None:
        oid = self.find(revision).oid
        if name in self.tags:
            raise Refused(409, "", f"Tag reference exists already: {name}")
        self.tags[name] = oid

    def untag(self, name: str) -> None:
        if self.tags.pop(name, None) is None:
            raise Refused(404, "RevisionNotFound", f"Tag {name} does not exist")

    def refs(self) -> dict[str, Any]:
        kinds = {"branches": ("heads", self.branches), "tags": ("tags", self.tags)}
        found: dict[str, Any] = {"converts": []}
        for kind, (folder, names) in kinds.items():
            found[kind] = [
                {"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": oid}
                for name, oid in sorted(names.items())
            ]
        return found

    def info(self, commit: Commit, *, gated: bool, blobs: bool) -> dict[str, Any]:
        siblings = []
        for path, blob in sorted(commit.files.items()):
            entry = blob.entry(path)
            told = {"size": entry["size"], "blobId": entry["oid"]} if blobs else {}
            if blobs and blob.large:
                told["lfs"] = {"sha256": blob.sha256, **entry["lfs"]}
            siblings.append({"rfilename": path, **told})
        known = {"_id": self.name, "id": self.id, "author": self.owner, "sha": commit.oid}
        dates = {"createdAt": DATE, "lastModified": DATE}
        rights = {"private": self.private, "gated": "manual" if gated else False, "disabled": False}
        counts = {"downloads": 0, "likes": 0, "tags": []}
        return {**known, **dates, **rights, **counts, "siblings": siblings}

    def upload_mode(self, commit: Commit, path: str, size: int) -> dict[str, Any]:
        """Tell how a file is to be uploaded, and what is there already."""
        there = commit.files.get(path)
        mode = "lfs" if is_large(path, size) else "regular"
        told = {"path": path, "uploadMode": mode, "shouldIgnore": False}
        return told | ({"oid": there.etag} if there else {})


def is_large(path: str, size: int) -> bool:
    return size > 0 and (path.endswith(LARGE_SUFFIXES) or size > LARGE_BYTES)
