"""A Hub on the loopback interface: all that its client requests to download and to publish.

Answers and rights are the Hub's as its client (huggingface_hub 1.33) knows them, with
`HF_ENDPOINT`, and `HF_HUB_DISABLE_XET=1` before it is imported. The API is on `127.0.0.1`; large
files are sent and stored under another hostname, `localhost`, where a token is an error.
"""

import base64
import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from support.hub_http import Answer, LoopbackServer, Request

type Match = re.Match[str]

_REPO = r"(?P<repo>(?:datasets/)?[^/]+/[^/]+?)"
_API = re.compile(
    r"/api/(?P<repo>(?:datasets|models)/[^/]+/[^/]+)(?:/(?P<what>[^/]+)/?(?P<rest>.*))?"
)
_FILE = re.compile(rf"/{_REPO}/resolve/(?P<revision>[^/]+)/(?P<path>.+)")
_OBJECTS = re.compile(rf"/{_REPO}\.git/info/lfs/objects/(?P<what>batch|verify)")
_STORE = re.compile(rf"/store/{_REPO}/(?P<oid>[0-9a-f]{{64}})(?:/(?P<path>.+))?")
_WRITES = ("auth-check", "commit", "preupload", "tag")

LARGE_SUFFIXES = (".arrow", ".bin", ".jpg", ".mp4", ".npy", ".npz", ".parquet", ".png", ".zip")
LARGE_BYTES = 10_000_000
"""What the Hub keeps as large files: such names, and what is bigger than that."""

GITATTRIBUTES = b"".join(
    b"*%b filter=lfs diff=lfs merge=lfs -text\n" % suffix.encode() for suffix in LARGE_SUFFIXES
)
"""The Hub's own file: its first commit holds nothing else."""


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
    def oid(self) -> str:
        """The object id that git gives the file, or what points to a large one."""
        kept = self.sha256.encode() if self.large else self.data
        return hashlib.sha1(b"blob %d\0%b" % (len(kept), kept)).hexdigest()

    @property
    def etag(self) -> str:
        return self.sha256 if self.large else self.oid

    def entry(self, path: str) -> dict[str, Any]:
        entry = {"type": "file", "path": path, "size": len(self.data), "oid": self.oid}
        if self.large:
            entry["lfs"] = {"oid": self.sha256, "size": len(self.data), "pointerSize": 134}
        return entry


@dataclass(frozen=True)
class Commit:
    """All files at one point of a repository's history."""

    oid: str
    title: str
    files: dict[str, Blob] = field(repr=False)


class Repository:
    """One repository: its commits by hash, branches and tags, and large files by SHA-256."""

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
        oid = oid or (revision if revision in self.commits else None)
        if oid is None:
            raise Refused(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return self.commits[oid]

    def add(self, files: dict[str, Blob], title: str, branch: str = "main") -> Commit:
        """Make a commit that holds these files, and let a branch point to it."""
        parent = self.branches.get(branch)
        sums = {path: blob.oid for path, blob in files.items()}
        content = json.dumps([self.name, parent, title, sums], sort_keys=True)
        oid = hashlib.sha1(content.encode()).hexdigest()
        self.store |= {blob.sha256: blob.data for blob in files.values() if blob.large}
        self.commits[oid] = Commit(oid, title, files)
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
            elif files.pop(path, None) is None:
                raise Refused(404, "EntryNotFound", "A file with this name doesn't exist")
        return self.add(files, title, branch)


def is_large(path: str, size: int) -> bool:
    return size > 0 and (path.endswith(LARGE_SUFFIXES) or size > LARGE_BYTES)


@dataclass(frozen=True)
class User:
    """Whom a token belongs to, and whether it may write."""

    name: str
    write: bool = True


class HubServer(LoopbackServer):
    """Repositories by name, such as `datasets/someone/small` or `someone/model`.

    Attributes:
        repositories: All that there are.
        tokens: Users by token; without a token one may read what is public.
        gated: Names of repositories whose files only their owner may download.
        renamed: New names by old ones.
    """

    def __init__(self) -> None:
        super().__init__()
        self.repositories: dict[str, Repository] = {}
        self.tokens: dict[str, User] = {}
        self.gated: set[str] = set()
        self.renamed: dict[str, str] = {}

    def push(self, repo: str, files: Path | dict[str, bytes], ref: str = "main") -> str:
        """Make a commit of a folder's files, let a branch point to it, and return its hash."""
        if isinstance(files, Path):
            found = (path for path in sorted(files.rglob("*")) if path.is_file())
            files = {path.relative_to(files).as_posix(): path.read_bytes() for path in found}
        blobs = {path: Blob.of(path, data) for path, data in files.items()}
        repository = self.repositories.setdefault(repo, Repository(repo))
        return repository.add(blobs, "Pushed", ref).oid

    def downloads(self) -> list[str]:
        """Return the files that were downloaded, in order."""
        sent = [one.path for one in self.asked if one.method == "GET" and one.status in (200, 206)]
        found = (_FILE.fullmatch(path) or _STORE.fullmatch(path) for path in sent)
        return [unquote(match["path"]) for match in found if match]

    def uploads(self) -> list[str]:
        """Return the SHA-256 of the large files that were uploaded, in order."""
        put = [one.path for one in self.asked if one.method == "PUT" and one.status == 200]
        return [match["oid"] for match in map(_STORE.fullmatch, put) if match]

    def answer(self, request: Request) -> Answer:
        """Return what the Hub answers."""
        try:
            return self._route(request)
        except Refused as error:
            fields = {"X-Error-Code": error.code, "X-Error-Message": str(error)}
            fields["X-Repo-Commit"] = error.commit
            headers = {name: text for name, text in fields.items() if text}
            return Answer.json({"error": str(error)}, error.status, headers)

    def _route(self, request: Request) -> Answer:
        if match := _STORE.fullmatch(request.path):
            return self._stored(request, self.repositories[match["repo"]], match)
        user = self._user(request.token)
        routes = {_API: self._api, _OBJECTS: self._objects, _FILE: self._file}
        for pattern, serve in routes.items():
            if match := pattern.fullmatch(request.path):
                name = match["repo"].removeprefix("models/")
                if name in self.renamed:
                    target = request.target.replace(name, self.renamed[name], 1)
                    return Answer.json({}, 307, {"Location": target})
                return serve(request, self._repository(name, user), user, match)
        return self._account(request, user)

    def _user(self, token: str | None) -> User | None:
        if token is not None and token not in self.tokens:
            raise Refused(401, "", "Invalid credentials in Authorization header")
        return None if token is None else self.tokens[token]

    def _repository(self, name: str, user: User | None) -> Repository:
        found = self.repositories.get(name)
        if found is None or (found.private and not (user and found.owner == user.name)):
            raise Refused(404 if user else 401, "RepoNotFound", "Repository not found")
        return found

    def _account(self, request: Request, user: User | None) -> Answer:
        """Serve what is of no repository: a look at a card, who asks, a new repository."""
        if request.path == "/api/validate-yaml":
            return Answer.json({"errors": [], "warnings": []})
        if user is None:
            raise Refused(401, "", "Invalid username or password.")
        if request.path == "/api/whoami-v2":
            auth = {"accessToken": {"role": "write" if user.write else "read"}}
            return Answer.json({"type": "user", "name": user.name, "orgs": [], "auth": auth})
        if request.path != "/api/repos/create":
            raise Refused(404, "", "Not found")
        asked = request.json()
        repo_id = f"{asked.get('organization') or user.name}/{asked['name']}"
        kind = asked.get("type", "model")
        name = repo_id if kind == "model" else f"{kind}s/{repo_id}"
        made = Repository(name, private=asked.get("visibility") == "private")
        _check_write(user, made)
        description = {"name": repo_id, "url": f"{self.endpoint}/{made.name}"}
        if made.name in self.repositories:
            return Answer.json({"error": "You already created this repo", **description}, 409)
        self.repositories[made.name] = made
        first = {".gitattributes": Blob(GITATTRIBUTES, large=False)}
        made.add(first, "initial commit")
        return Answer.json(description)

    def _api(self, request: Request, repo: Repository, user: User | None, match: Match) -> Answer:
        what, rest = match["what"] or "revision", unquote(match["rest"] or "main")
        if what in _WRITES:
            _check_write(user, repo)
        if what == "refs":
            kinds = {"branches": repo.branches, "tags": repo.tags}
            refs = {
                kind: [{"name": n, "ref": n, "targetCommit": oid} for n, oid in names.items()]
                for kind, names in kinds.items()
            }
            return Answer.json({"converts": [], **refs})
        if what == "tag":
            if request.method == "DELETE":
                del repo.tags[rest]
            else:
                name = request.json()["tag"]
                if name in repo.tags:
                    raise Refused(409, "", f"Tag reference exists already: {name}")
                repo.tags[name] = repo.find(rest).oid
            return Answer.json({})
        if what == "commit":
            made = repo.commit(rest, request.body.splitlines()).oid
            url = f"{self.endpoint}/{repo.name}/commit/{made}"
            return Answer.json({"success": True, "commitOid": made, "commitUrl": url})
        if what == "auth-check":
            return Answer.json({})
        return self._read(request, repo, what, match["rest"] or "main")

    def _read(self, request: Request, repo: Repository, what: str, rest: str) -> Answer:
        commit = repo.find(unquote(rest.partition("/")[0]))
        if what == "revision":
            siblings = [{"rfilename": path} for path in sorted(commit.files)]
            info = {"id": repo.id, "sha": commit.oid, "private": repo.private}
            return Answer.json({"_id": repo.name, **info, "siblings": siblings})
        if what == "preupload":
            modes = []
            for one in request.json()["files"]:
                mode = "lfs" if is_large(one["path"], one["size"]) else "regular"
                modes.append({"path": one["path"], "uploadMode": mode, "shouldIgnore": False})
                if existing := commit.files.get(one["path"]):
                    modes[-1]["oid"] = existing.etag
            return Answer.json({"files": modes})
        if what != "tree":
            raise Refused(404, "", "Not found")
        return Answer.json([blob.entry(path) for path, blob in sorted(commit.files.items())])

    def _file(self, request: Request, repo: Repository, user: User | None, match: Match) -> Answer:
        """Serve a file, or tell where a large one is."""
        if repo.name in self.gated and not (user and repo.owner == user.name):
            raise Refused(403 if user else 401, "GatedRepo", f"Access to {repo.id} is restricted")
        commit, path = repo.find(unquote(match["revision"])), unquote(match["path"])
        if path not in commit.files:
            raise Refused(404, "EntryNotFound", "Entry not found", commit.oid)
        blob = commit.files[path]
        headers = {"X-Repo-Commit": commit.oid, "ETag": f'"{blob.etag}"'}
        if not blob.large:
            return Answer(blob.data, headers=headers, plain=True)
        place = f"{self.elsewhere}/store/{repo.name}/{blob.sha256}/{quote(path)}"
        linked = {"X-Linked-Etag": f'"{blob.sha256}"', "X-Linked-Size": str(len(blob.data))}
        return Answer(b"", 302, {**headers, **linked, "Location": place})

    def _objects(
        self, request: Request, repo: Repository, user: User | None, match: Match
    ) -> Answer:
        """Tell where large files are to be stored, and whether one has come."""
        _check_write(user, repo)
        asked, objects = request.json(), f"{repo.name}.git/info/lfs/objects"
        if match["what"] == "verify":
            if len(repo.store.get(asked["oid"], b"")) != asked["size"]:
                raise Refused(400, "", "this file has not come")
            return Answer.json({})
        objects_found = []
        for one in asked["objects"]:
            objects_found.append({"oid": one["oid"], "size": one["size"]})
            if one["oid"] not in repo.store:
                upload = {"href": f"{self.elsewhere}/store/{repo.name}/{one['oid']}"}
                verify = {"href": f"{self.endpoint}/{objects}/verify"}
                objects_found[-1]["actions"] = {"upload": upload, "verify": verify}
        return Answer.json({"transfer": "basic", "objects": objects_found})

    def _stored(self, request: Request, repo: Repository, match: re.Match[str]) -> Answer:
        """Serve the place of large files: its addresses are secret, and it takes no token."""
        if request.token is not None or request.host != "localhost":
            raise Refused(400, "", "Only one auth mechanism allowed")
        if request.method != "PUT":
            return Answer(repo.store[match["oid"]], headers={"ETag": f'"{match["oid"]}"'})
        if Blob(request.body, large=True).sha256 != match["oid"]:
            raise Refused(400, "", "not the bytes that were announced")
        repo.store[match["oid"]] = request.body
        return Answer(b"")


def _check_write(user: User | None, repo: Repository) -> None:
    if user is None:
        raise Refused(401, "", "Invalid username or password.")
    if not user.write or repo.owner != user.name:
        raise Refused(403, "", f"this token may not write to repositories of {repo.owner}")
