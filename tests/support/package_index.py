"""A package index on the loopback interface: the simple index, and uploads as twine makes them.

It refuses what a public index refuses: an upload without a known user, under a name that somebody
else registered, of a file that exists, and of one whose digest differs. An index of ours because
lerobot 0.6 and pypiserver 2.4 ask for different versions of `packaging`.
"""

import base64
import hashlib
import re
from dataclasses import dataclass, field
from email import message_from_bytes
from html import escape
from pathlib import Path

from support.hub_http import Answer, LoopbackServer, Request


@dataclass
class Project:
    """A name that is registered: its owner, and its files by name."""

    owner: str
    files: dict[str, bytes] = field(default_factory=dict, repr=False)


class PackageIndex(LoopbackServer):
    """An index with its projects by normalized name.

    Attributes:
        projects: All that there are.
        passwords: Those who may upload, with their passwords.
    """

    def __init__(self) -> None:
        super().__init__()
        self.projects: dict[str, Project] = {}
        self.passwords: dict[str, str] = {}

    @property
    def simple(self) -> str:
        """The address that installers read."""
        return f"{self.endpoint}/simple"

    @property
    def legacy(self) -> str:
        """The address that twine sends files to."""
        return f"{self.endpoint}/legacy/"

    def add(self, name: str, owner: str, *files: Path) -> None:
        """Register a name with files, as if they had been uploaded before."""
        self.projects[normalized(name)] = Project(
            owner, {file.name: file.read_bytes() for file in files}
        )

    def answer(self, request: Request) -> Answer:
        """Return what the index answers."""
        match request.method, request.path.strip("/").split("/"):
            case "POST", ["legacy"]:
                return self._upload(request)
            case "GET" | "HEAD", ["simple", name] if name in self.projects:
                return _page(name, self.projects[name])
            case "GET" | "HEAD", ["files", name, file] if file in self.projects[name].files:
                return Answer(self.projects[name].files[file])
        return Answer(b"not found", 404)

    def _upload(self, request: Request) -> Answer:
        user = self._user(request)
        if user is None:
            return Answer(b"Invalid or non-existent authentication information.", 403)
        fields, file, data = _form(request)
        project = self.projects.setdefault(normalized(fields["name"]), Project(user))
        if project.owner != user:
            return Answer(b"The user isn't allowed to upload to this project.", 403)
        if file in project.files:
            return Answer(b"File already exists.", 400)
        if hashlib.sha256(data).hexdigest() != fields["sha256_digest"]:
            return Answer(b"The digest supplied does not match the file.", 400)
        project.files[file] = data
        return Answer(b"")

    def _user(self, request: Request) -> str | None:
        given = request.headers.get("Authorization", "").removeprefix("Basic ")
        user, _, password = base64.b64decode(given).decode().partition(":")
        return user if user in self.passwords and self.passwords[user] == password else None


def normalized(name: str) -> str:
    """Return a project's name as addresses have it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _page(name: str, project: Project) -> Answer:
    links = [
        f'<a href="/files/{name}/{escape(file)}#sha256={hashlib.sha256(data).hexdigest()}">'
        f"{escape(file)}</a>"
        for file, data in project.files.items()
    ]
    page = f"<!DOCTYPE html><html><body>{''.join(links)}</body></html>"
    return Answer(page.encode(), headers={"Content-Type": "text/html"})


def _form(request: Request) -> tuple[dict[str, str], str, bytes]:
    """Return the fields of an upload, and its file's name and content."""
    head = f"Content-Type: {request.headers['Content-Type']}\r\n\r\n"
    fields, file, data = {}, "", b""
    for part in message_from_bytes(head.encode() + request.body).get_payload():
        content = part.get_payload(decode=True)
        if part.get_filename():
            file, data = part.get_filename(), content
        else:
            name = part.get_param("name", header="content-disposition")
            fields[name] = content.decode()
    return fields, file, data
