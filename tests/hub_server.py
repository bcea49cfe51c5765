"""A Hub on the loopback interface: what the client asks of it to find and download datasets."""

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

_PAGE = 3
"""Entries in one answer of a file listing; more follow by a Link header, as on the real Hub."""


class HubServer:
    """Dataset repositories by id.

    Attributes:
        requests: Every request so far, as `GET /api/datasets/…`.
        gated: Ids of repositories that answer 403.
        down: Answer 503 to everything.
    """

    def __init__(self) -> None:
        self.requests: list[str] = []
        self.gated: set[str] = set()
        self.down = False
        self._commits: dict[str, dict[str, dict[str, bytes]]] = {}
        self._refs: dict[str, dict[str, str]] = {}
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}"

    def push(self, repo: str, files: Path | dict[str, bytes], ref: str = "main") -> str:
        """Make a commit of a folder's files, let a branch point to it, and return its hash."""
        if isinstance(files, Path):
            files = {
                path.relative_to(files).as_posix(): path.read_bytes()
                for path in sorted(files.rglob("*"))
                if path.is_file()
            }
        sums = {path: hashlib.sha1(data).hexdigest() for path, data in files.items()}
        commit = hashlib.sha1(json.dumps(sums, sort_keys=True).encode()).hexdigest()
        self._commits.setdefault(repo, {})[commit] = files
        self._refs.setdefault(repo, {})[ref] = commit
        return commit

    def downloads(self) -> list[str]:
        """Return the files that were downloaded, in order."""
        gets = [request for request in self.requests if request.startswith("GET /datasets/")]
        return [request.split("/resolve/")[1].split("/", 1)[1] for request in gets]

    @contextmanager
    def running(self) -> Iterator["HubServer"]:
        thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._server.shutdown()
            self._server.server_close()
            thread.join()

    def answer(self, path: str, query: dict[str, list[str]]) -> tuple[int, dict[str, str], Any]:
        """Return status, headers and body (bytes, or a value to send as JSON)."""
        parts = path.strip("/").removeprefix("api/").split("/")
        repo, rest = "/".join(parts[1:3]), parts[3:]
        commits, refs = self._commits.get(repo, {}), self._refs.get(repo, {})
        revision = unquote(rest[1]) if len(rest) > 1 else "main"
        commit = refs.get(revision, revision)
        if self.down:
            return _error(503, "Down")
        if parts[0] != "datasets" or not commits:
            return _error(401, "RepoNotFound")
        if repo in self.gated:
            return _error(403, "GatedRepo")
        if commit not in commits:
            return _error(404, "RevisionNotFound")
        return self._content(path, query, repo, commit, "/".join(rest[2:]))

    def _content(
        self, path: str, query: dict[str, list[str]], repo: str, commit: str, below: str
    ) -> tuple[int, dict[str, str], Any]:
        files = self._commits[repo][commit]
        if "/tree/" in path:
            return self._tree(path, query, files, below)
        if path.startswith("/api/"):
            return 200, {}, {"id": repo, "sha": commit, "siblings": [], "private": False}
        if below not in files:
            return _error(404, "EntryNotFound", commit)
        etag = hashlib.sha1(files[below]).hexdigest()
        return 200, {"X-Repo-Commit": commit, "ETag": f'"{etag}"'}, files[below]

    def _tree(
        self, path: str, query: dict[str, list[str]], files: dict[str, bytes], folder: str
    ) -> tuple[int, dict[str, str], Any]:
        below = sorted(name for name in files if name.startswith(f"{folder}/") or not folder)
        if not below:
            return _error(404, "EntryNotFound")
        start = int(query.get("cursor", ["0"])[0])
        entries = [
            {
                "type": "file",
                "path": name,
                "size": len(files[name]),
                "oid": hashlib.sha1(files[name]).hexdigest(),
            }
            for name in below[start : start + _PAGE]
        ]
        headers = {}
        if start + _PAGE < len(below):
            following = f"{self.endpoint}{path}?recursive=True&cursor={start + _PAGE}"
            headers["Link"] = f'<{following}>; rel="next"'
        return 200, headers, [{"type": "directory", "path": folder, "oid": "0"}, *entries]

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        hub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                self._respond(body=True)

            def do_HEAD(self) -> None:
                self._respond(body=False)

            def _respond(self, body: bool) -> None:
                url = urlsplit(self.path)
                hub.requests.append(f"{self.command} {url.path}")
                status, headers, value = hub.answer(url.path, parse_qs(url.query))
                data = value if isinstance(value, bytes) else json.dumps(value).encode()
                self.send_response(status)
                for name, text in headers.items():
                    self.send_header(name, text)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                if body:
                    self.wfile.write(data)

            def log_message(self, *_: Any) -> None:
                pass

        return Handler


def _error(status: int, code: str, commit: str = "") -> tuple[int, dict[str, str], Any]:
    return status, {"X-Error-Code": code, "X-Repo-Commit": commit}, {"error": code}
