"""A small hub on this machine, and the real huggingface_hub."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import comic.hub
import pytest
from exports import GIF, LOW_LEVEL, POLICY, changed

REPOSITORY = "somebody/walker"
TOKEN = "hf_thisIsNoTokenOfAnybody"


def test_without_huggingface_hub_the_error_names_the_option_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"pip install comic-rl\[hub\]"):
        comic.hub.pull(REPOSITORY)
    with pytest.raises(ImportError, match=r"pip install comic-rl\[hub\]"):
        comic.hub.push(POLICY, REPOSITORY)


class Hub(ThreadingHTTPServer):
    """What huggingface_hub needs of a hub, with one repository."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answers)
        self.files: dict[str, bytes] = {}
        self.large: dict[str, bytes] = {}
        self.requests: list[str] = []
        self.commit = ""
        self.claimed: int | None = None
        """Length of a file that the answer claims, instead of its own."""

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Answers(BaseHTTPRequestHandler):
    server: Hub

    def answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(body))} | headers).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def json(self, value: Any) -> None:
        self.answer(200, json.dumps(value).encode(), Content_Type="application/json")

    def body(self) -> bytes:
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def do_POST(self) -> None:
        body, hub = self.body(), self.server
        hub.requests.append(f"POST {self.path}")
        if self.path == "/api/validate-yaml":
            return self.json({"errors": [], "warnings": []})
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self.answer(401, b"", X_Error_Message="Invalid username or password.")
        match self.path.removeprefix(f"/api/models/{REPOSITORY}").removeprefix(f"/{REPOSITORY}"):
            case "/api/repos/create":
                self.json({"url": f"{hub.address}/{REPOSITORY}"})
            case "/preupload/main":
                modes = {True: "lfs", False: "regular"}
                asked = [file["path"] for file in json.loads(body)["files"]]
                files = [
                    {"path": path, "uploadMode": modes[path.endswith(("safetensors", "gif"))], "shouldIgnore": False}
                    for path in asked
                ]
                self.json({"files": files})
            case ".git/info/lfs/objects/batch":
                objects = [
                    entry | {"actions": {"upload": {"href": f"{hub.address}/large/{entry['oid']}"}}}
                    for entry in json.loads(body)["objects"]
                ]
                self.json({"transfer": "basic", "objects": objects})
            case "/commit/main":
                for line in map(json.loads, body.splitlines()):
                    value = line["value"]
                    if line["key"] == "file":
                        hub.files[value["path"]] = base64.b64decode(value["content"])
                    elif line["key"] == "lfsFile":
                        hub.files[value["path"]] = hub.large[value["oid"]]
                hub.commit = hashlib.sha1(body).hexdigest()
                self.json({"commitUrl": f"{hub.address}/{REPOSITORY}/commit/{hub.commit}", "commitOid": hub.commit})
            case _:
                self.answer(404)
        return None

    def do_PUT(self) -> None:
        body = self.body()
        self.server.large[self.path.removeprefix("/large/")] = body
        self.answer(200)

    def do_GET(self) -> None:
        hub = self.server
        # The library also asks for a list of coding agents.
        if REPOSITORY in self.path:
            hub.requests.append(f"{self.command} {self.path}")
        repository, _, rest = self.path.removeprefix("/").partition("/resolve/")
        revision, _, name = rest.partition("/")
        if repository != REPOSITORY:
            return self.answer(401, b"", X_Error_Code="RepoNotFound", X_Error_Message="Repository not found")
        if revision not in ("main", hub.commit):
            return self.answer(404, b"", X_Error_Code="RevisionNotFound", X_Error_Message="Invalid rev id")
        if name not in hub.files:
            return self.answer(404, b"", X_Error_Code="EntryNotFound", X_Error_Message="Entry not found")
        content = hub.files[name]
        linked = {"X_Linked_Size": str(hub.claimed)} if hub.claimed else {}
        return self.answer(200, content, ETag=f'"{hashlib.sha256(content).hexdigest()}"', X_Repo_Commit=hub.commit, **linked)

    do_HEAD = do_GET

    def log_message(self, format: str, *arguments: Any) -> None:
        pass


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


# Every connection is to this machine, or to nothing at all.
_GUARDED = """
import socket, sys, time
if not ALLOWED:
    # The library waits between its attempts.
    time.sleep = lambda seconds: None
connect = socket.socket.connect
def guarded(self, address):
    if self.family != socket.AF_UNIX and (not ALLOWED or address[0] != "127.0.0.1"):
        print(f"connection to {address}", file=sys.stderr)
        raise OSError("no network in this test")
    return connect(self, address)
socket.socket.connect = guarded
from comic.hub import main
main()
"""


def program(hub: Hub, home: Path, *arguments: str, connected: bool = True, **environment: str) -> tuple[int, str, str]:
    """Exit code, output and errors of the program, in its own process: the library reads the environment once."""
    settings = {
        "HF_ENDPOINT": hub.address,
        "HF_HOME": str(home),
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_UPDATE_CHECK": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_TOKEN": TOKEN,
        "NO_PROXY": "*",
    }
    script = f"ALLOWED = {connected}\n{_GUARDED}"
    ended = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env=os.environ | settings | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    # Nothing that is secret is printed.
    assert TOKEN not in ended.stdout + ended.stderr
    return ended.returncode, ended.stdout.strip(), ended.stderr.strip()


@pytest.mark.full
def test_what_was_pushed_is_pulled_and_is_the_same(hub: Hub, tmp_path: Path) -> None:
    film = tmp_path / "walk.gif"
    film.write_bytes(GIF)
    code, commit, errors = program(hub, tmp_path, "push", str(LOW_LEVEL), REPOSITORY, "--film", str(film))
    assert (code, commit) == (0, f"{hub.address}/{REPOSITORY}/commit/{hub.commit}"), errors
    expected = comic.hub.contents(LOW_LEVEL, REPOSITORY, film=film)
    assert hub.files == expected and not any(TOKEN.encode() in content for content in hub.files.values())
    code, path, errors = program(hub, tmp_path, "pull", REPOSITORY)
    assert code == 0, errors
    assert Path(path).name == "model.safetensors" and Path(path).read_bytes() == LOW_LEVEL.read_bytes()
    assert program(hub, tmp_path, "pull", REPOSITORY, "--revision", hub.commit)[:2] == (0, path)


@pytest.mark.full
def test_what_was_pulled_before_needs_no_network(hub: Hub, tmp_path: Path) -> None:
    hub.files, hub.commit = {"model.safetensors": POLICY.read_bytes()}, "0" * 40
    path = program(hub, tmp_path, "pull", REPOSITORY)[1]
    assert path
    # Told that there is no network, it does not try. Not told, it tries, and nothing lets it.
    offline = program(hub, tmp_path, "pull", REPOSITORY, connected=False, HF_HUB_OFFLINE="1")
    assert offline == (0, path, "")
    code, found, errors = program(hub, tmp_path, "pull", REPOSITORY, connected=False)
    assert (code, found) == (0, path) and "connection to" in errors
    assert program(hub, tmp_path, "pull", REPOSITORY, "--revision", hub.commit, connected=False)[:2] == (0, path)


@pytest.mark.full
@pytest.mark.parametrize("offline", ["0", "1"])
def test_without_network_and_cache_the_error_names_the_remedy(hub: Hub, tmp_path: Path, offline: str) -> None:
    code, _, errors = program(hub, tmp_path, "pull", REPOSITORY, connected=False, HF_HUB_OFFLINE=offline)
    assert code == 1 and f"error: {REPOSITORY}: model.safetensors is not pulled: the hub cannot be reached" in errors
    assert "pull it once with a network" in errors
    code, _, errors = program(hub, tmp_path, "push", str(POLICY), REPOSITORY, connected=False, HF_HUB_OFFLINE=offline)
    assert code == 1 and f"error: {REPOSITORY}: model.safetensors is not pushed: the hub cannot be reached" in errors
    assert not hub.requests


@pytest.mark.full
def test_what_is_missing_or_forbidden_is_named(hub: Hub, tmp_path: Path) -> None:
    hub.files, hub.commit = {"README.md": b""}, "0" * 40
    cases = {
        ("pull", "somebody/else"): "there is no such repository, or this login may not use it",
        ("pull", "no/such/name"): "it is no name of a repository: give NAME/REPOSITORY",
        ("pull", REPOSITORY, "--revision", "v9"): "there is no such revision",
        ("pull", REPOSITORY): "the repository has no such file",
    }
    for arguments, reason in cases.items():
        code, _, errors = program(hub, tmp_path, *arguments)
        assert code == 1 and errors.startswith(f"error: {arguments[1]}: model.safetensors is not pulled: {reason}"), errors
    code, _, errors = program(hub, tmp_path, "push", str(POLICY), REPOSITORY, HF_TOKEN="hf_another")
    assert code == 1 and "is not pushed: " in errors and "hf auth login" in errors and "hf_another" not in errors


@pytest.mark.full
def test_a_pulled_file_that_is_no_policy_is_refused(hub: Hub, tmp_path: Path) -> None:
    hub.files, hub.commit = {"model.safetensors": changed(POLICY.read_bytes(), format=9)}, "1" * 40
    code, path, errors = program(hub, tmp_path, "pull", REPOSITORY)
    assert (code, path) == (1, "") and errors.startswith(f"error: {REPOSITORY}: ")
    assert "model.safetensors: format: 9, and this release reads 1 and 2: export it again" in errors


@pytest.mark.full
def test_a_file_that_is_too_long_is_not_even_downloaded(hub: Hub, tmp_path: Path) -> None:
    hub.files, hub.commit, hub.claimed = {"model.safetensors": POLICY.read_bytes()}, "2" * 40, (1 << 30) + 1
    code, _, errors = program(hub, tmp_path, "pull", REPOSITORY)
    assert code == 1 and "model.safetensors has 1073741825 bytes, and at most 1073741824 are read" in errors
    assert hub.requests == [f"HEAD /{REPOSITORY}/resolve/main/model.safetensors"]
