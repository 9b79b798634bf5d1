"""A small Hugging Face Hub on this machine's loopback: it keeps repositories in a folder and serves what was uploaded.

Each repository has one branch, whose commits replace each other; a tag is a name of it.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit


class FakeHub(ThreadingHTTPServer):
    """Repositories lie in folder/models/user/name and folder/datasets/user/name."""

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folder = folder
        self.created: list[dict] = []
        self.tags: dict[str, list[str]] = {}
        self.n_commits = 0
        self.is_full = False
        """Whether it refuses commits, as a real one does when the user's quota is used up."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def files(self, repository: str) -> dict[str, bytes]:
        """The content of a repository, such as 'models/user/name', by path."""
        root = self.folder / repository
        return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


class _Handler(BaseHTTPRequestHandler):
    server: FakeHub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        pass

    @property
    def _parts(self) -> list[str]:
        return [unquote(part) for part in urlsplit(self.path).path.strip("/").split("/")]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        match self._parts:
            case ["api", "repos", "create"]:
                self._create(json.loads(body))
            case ["api", kind, user, name, "preupload", _]:
                files = [
                    {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False, "oid": None}
                    for file in json.loads(body)["files"]
                ]
                self._answer({"files": files})
            case ["api", kind, user, name, "commit", _]:
                self._commit(f"{kind}/{user}/{name}", [json.loads(line) for line in body.splitlines()])
            case ["api", kind, user, name, "tag", _]:
                self.server.tags.setdefault(f"{kind}/{user}/{name}", []).append(json.loads(body)["tag"])
                self._answer({})
            case ["api", kind, user, name, "paths-info", _]:
                self._answer([])
            case _:
                self._answer({"errors": [], "warnings": []})

    def do_GET(self) -> None:
        match self._parts:
            case ["api", "whoami-v2"]:
                self._answer({"name": "tester"})
            case ["api", kind, user, name, "refs"]:
                repository = f"{kind}/{user}/{name}"
                refs = [{"name": "main", "ref": "refs/heads/main", "targetCommit": self._sha}]
                tags = [
                    {"name": tag, "ref": f"refs/tags/{tag}", "targetCommit": self._sha}
                    for tag in self.server.tags.get(repository, [])
                ]
                self._answer({"branches": refs, "converts": [], "tags": tags})
            case ["api", kind, user, name, "tree", *_]:
                self._answer(
                    [
                        {"type": "file", "path": path, "size": len(content), "oid": _oid(content)}
                        for path, content in self.server.files(f"{kind}/{user}/{name}").items()
                    ]
                )
            case ["api", kind, user, name, *_]:
                self._info(kind, f"{user}/{name}")
            case ["datasets", user, name, "resolve", _, *path]:
                self._file(f"datasets/{user}/{name}", "/".join(path))
            case [user, name, "resolve", _, *path]:
                self._file(f"models/{user}/{name}", "/".join(path))
            case _:
                self._missing("RepoNotFound")

    do_HEAD = do_GET

    def do_DELETE(self) -> None:
        self._answer({})

    @property
    def _sha(self) -> str:
        return f"{self.server.n_commits:040d}"

    def _create(self, request: dict) -> None:
        self.server.created.append(request)
        kind = request.get("type") or "model"
        name = f"{request.get('organization') or 'tester'}/{request['name']}"
        (self.server.folder / f"{kind}s" / name).mkdir(parents=True, exist_ok=True)
        self._answer({"url": f"{self.server.url}/{name}", "name": name, "id": name})

    def _commit(self, repository: str, items: list[dict]) -> None:
        if self.server.is_full:
            self._answer({"error": "Your storage is full."}, status=403)
            return
        for item in items:
            if item["key"] == "file":
                path = self.server.folder / repository / item["value"]["path"]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(base64.b64decode(item["value"]["content"]))
        self.server.n_commits += 1
        name = repository.removeprefix("models/")
        self._answer({"commitUrl": f"{self.server.url}/{name}/commit/{self._sha}", "commitOid": self._sha})

    def _info(self, kind: str, name: str) -> None:
        if not (self.server.folder / kind / name).is_dir():
            self._missing("RepoNotFound")
            return
        siblings = [{"rfilename": path} for path in self.server.files(f"{kind}/{name}")]
        self._answer({"id": name, "sha": self._sha, "siblings": siblings, "tags": [], "private": False})

    def _file(self, repository: str, path: str) -> None:
        content = self.server.files(repository).get(path)
        if content is None:
            self._missing("EntryNotFound")
        else:
            self._send(200, content, "application/octet-stream", ETag=f'"{_oid(content)}"')

    def _missing(self, code: str) -> None:
        self._send(404, b"", "text/plain", **{"X-Error-Code": code})

    def _answer(self, content: object, status: int = 200) -> None:
        self._send(status, json.dumps(content).encode(), "application/json")

    def _send(self, status: int, data: bytes, kind: str, **headers: str) -> None:
        self.send_response(status)
        for name, value in {"X-Repo-Commit": self._sha, **headers}.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


def _oid(content: bytes) -> str:
    return hashlib.sha1(content).hexdigest()


@contextmanager
def running_hub(folder: Path) -> Iterator[FakeHub]:
    """Serve until the block ends."""
    hub = FakeHub(folder)
    thread = threading.Thread(target=hub.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        hub.shutdown()
        hub.server_close()
