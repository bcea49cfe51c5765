"""A Hub on the loopback interface: what the client asks of it to find and download files."""

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

Answer = tuple[int, dict[str, str], Any]


class HubServer:
    """Repositories by id, such as `datasets/someone/small` or `someone/model`.

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
            found = (path for path in sorted(files.rglob("*")) if path.is_file())
            files = {path.relative_to(files).as_posix(): path.read_bytes() for path in found}
        sums = {path: _sha1(data) for path, data in files.items()}
        commit = _sha1(json.dumps(sums, sort_keys=True).encode())
        self._commits.setdefault(repo, {})[commit] = files
        self._refs.setdefault(repo, {})[ref] = commit
        return commit

    def downloads(self) -> list[str]:
        """Return the files that were downloaded, in order."""
        gets = [request for request in self.requests if request.startswith("GET")]
        return [one.split("/resolve/")[1].split("/", 1)[1] for one in gets if "/resolve/" in one]

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

    def answer(self, path: str) -> Answer:  # noqa: PLR0911
        """Return status, headers and body (bytes, or a value to send as JSON)."""
        if self.down:
            return _error(503, "Down")
        parts = path.strip("/").removeprefix("api/").removeprefix("models/").split("/")
        named = 3 if parts[0] == "datasets" else 2
        repo, rest = "/".join(parts[:named]), parts[named:]
        if repo not in self._commits:
            return _error(401, "RepoNotFound")
        if repo in self.gated:
            return _error(403, "GatedRepo")
        what, revision, *below = [*rest, "main"] if len(rest) < 2 else rest
        commit = self._refs[repo].get(unquote(revision), revision)
        files = self._commits[repo].get(commit)
        if files is None:
            return _error(404, "RevisionNotFound")
        if what == "tree":
            entries = [
                {"type": "file", "path": name, "size": len(data), "oid": _sha1(data)}
                for name, data in sorted(files.items())
            ]
            return 200, {}, entries
        if what != "resolve":
            return 200, {}, {"id": repo, "sha": commit, "siblings": [], "private": False}
        data = files.get(unquote("/".join(below)))
        if data is None:
            return _error(404, "EntryNotFound", commit)
        return 200, {"X-Repo-Commit": commit, "ETag": f'"{_sha1(data)}"'}, data

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        hub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                path = urlsplit(self.path).path
                hub.requests.append(f"{self.command} {path}")
                status, headers, value = hub.answer(path)
                data = value if isinstance(value, bytes) else json.dumps(value).encode()
                self.send_response(status)
                for name, text in {**headers, "Content-Length": str(len(data))}.items():
                    self.send_header(name, text)
                self.end_headers()
                if self.command == "GET":
                    self.wfile.write(data)

            do_HEAD = do_GET

            def log_message(self, *_: Any) -> None:
                pass

        return Handler


def _sha1(data: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()  # as Git names it


def _error(status: int, code: str, commit: str = "") -> Answer:
    return status, {"X-Error-Code": code, "X-Repo-Commit": commit}, {"error": code}
