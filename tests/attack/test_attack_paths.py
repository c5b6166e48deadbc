"""Paths that lead out of what may be read: in every path parameter, in the folders' list, in the page's own files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from live_server import running
from raw import request, require_alive

from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from live_server import Live

SECRET = b"the-secret-outside"
PARTS = (
    "..",
    "%2e%2e",
    "..%2f..%2f..%2f..%2fetc%2fpasswd",
    "%252e%252e%252fsecret",
    "..%5c..%5csecret",
    "%2fetc%2fpasswd",
    "room%2f..%2f..%2fsecret",
    "room%00",
    "%00",
    "%ff%fe",
    "%c0%ae%c0%ae%2f",
    "%ed%a0%80",
    ".jobs",
    ".uploads",
    "room%20",
    "room.",
    "~",
    "%0d%0aSet-Cookie:%20a=b",
    "<script>alert(1)</script>",
    "a" * 5000,
    "-1",
    "9" * 400,
    "1e3",
    "١",
)
FILES = (
    "../secret",
    "%2e%2e/secret",
    "..%2fsecret",
    "..\\secret",
    "//etc/passwd",
    "%2fetc%2fpasswd",
    "js/../../secret",
)


@pytest.fixture
def places(web_settings: ServerSettings, generated: Path, tmp_path: Path) -> Iterator[Live]:
    """A server whose registered folder also has links that lead out of it, beside a secret."""
    (tmp_path / "secret").write_bytes(SECRET)
    (web_settings.projects_root / "secret").write_bytes(SECRET)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, target in (("out", generated), ("up", ".."), ("loop", "loop"), ("file", tmp_path / "secret")):
        (folder / name).symlink_to(target)
    (folder / ".hidden").symlink_to(generated)
    with running(ServerSettings(web_settings.projects_root, (folder,), port=0)) as live:
        yield live


def test_no_path_parameter_leads_out(places: Live, tmp_path: Path) -> None:
    paths = places.client.get("/api/openapi.json").json()["paths"]
    operations = [(path, method.upper()) for path, methods in paths.items() for method in methods if "{" in path]
    assert len(operations) > 30
    wrong = []
    for path, method in operations:
        names = re.findall(r"\{[^}]*\}", path)
        for part in PARTS:
            for name in names:
                # the other parameters exist
                target = path.replace(name, part)
                target = re.sub(r"\{(project|name)\}", "room", target)
                target = re.sub(r"\{[^}]*\}", "1", target)
                status, answer = request(places, method, target, b"" if method == "GET" else b"{}")
                head = answer.partition(b"\r\n\r\n")[0].lower()
                leaks = SECRET in answer or b"root:" in answer or str(tmp_path).encode() in answer
                # a slash at the end is redirected away; tracks may have negative numbers
                refused = 400 <= status < 500 or (status == 307 and f"location: {places.url}/".encode() in head)
                refused = refused or re.search(r"/tracks/-1(/sheet)?$", target) is not None
                if not refused or leaks or b"set-cookie" in head:
                    wrong.append((method, target[:200], status))
    assert wrong == []
    require_alive(places)


@pytest.mark.parametrize("prefix", ["/assets/", "/", "/viser/1/", "/assets/js/", "/assets/vendor/"])
def test_no_file_beside_the_page_is_served(places: Live, prefix: str) -> None:
    for name in (*FILES, *PARTS, "../../../../../../../etc/passwd", "..;/secret", "js//../../pyproject.toml"):
        status, answer = request(places, "GET", prefix + name)
        assert 400 <= status < 500, (prefix + name, status)
        assert SECRET not in answer and b"root:" not in answer and b"[project]" not in answer


FOLDERS = [
    "..", "folder/..", "folder/../..", "/", "/etc", "folder/out", "folder/up", "folder/loop", "folder/file", "folder//",
    "folder/./", "folder/.hidden", "folder\\..\\..", "folder/\0", "C:\\", "file:///etc", "~", "$HOME",
    "folder/" + "a" * 300,    "folder/" + "a/" * 1000, "\ud800", "s3://bucket/x", "http://127.0.0.1:1/",
]  # fmt: skip


@pytest.mark.parametrize("path", FOLDERS, ids=lambda path: ascii(path[:30]))
def test_recordings_come_from_the_registered_folders_only(places: Live, path: str) -> None:
    asked: list[tuple[str, str, dict[str, Any]]] = [
        ("GET", "/api/folders", {"params": {"path": path.encode("utf-8", "surrogatepass")}}),
        ("GET", "/api/bags", {"params": {"path": path.encode("utf-8", "surrogatepass")}}),
    ]
    if path.isascii():
        asked += [
            ("POST", "/api/projects/room/recordings", {"json": {"path": path}}),
            ("PATCH", "/api/projects/room/recordings/1", {"json": {"path": path}}),
        ]
    before = places.client.get("/api/projects/room").json()
    for method, target, given in asked:
        answer = places.client.request(method, target, **given)
        assert 400 <= answer.status_code < 500, (method, target, answer.text)
        assert "etc" not in answer.text.replace(path, "") and SECRET not in answer.content
    assert places.client.get("/api/projects/room").json() == before


def test_listings_leave_out_links_that_lead_out(places: Live) -> None:
    listed = places.client.get("/api/folders", params={"path": "folder"}).json()
    assert listed["entries"] == []


@pytest.mark.parametrize(
    "name", ["..", ".", "", "a/b", "/abs", "a\0b", "a\nb", "nul\\x", "x" * 300, "é", "a b", "-rf", ".x"]
)
def test_projects_have_plain_names(places: Live, name: str) -> None:
    root = places.settings.projects_root
    before = sorted(path.name for path in root.iterdir())
    answer = places.client.post("/api/projects", json={"name": name, "classes": ["person"]})
    assert 400 <= answer.status_code < 500, answer.text
    assert sorted(path.name for path in root.iterdir()) == before
