"""Fetching of recorded pushes, from a server on the loopback interface that also fails in every way."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

import pytest

from pushjax.cli import main as cli
from pushjax.datasets import download, find_data
from pushjax.datasets.download import RemoteFile, fetch, triangle_files
from pushjax.datasets.load import default_folder

CONTENT = {"a log/exp 12:30.txt": b"50 pushes" * 1000, "b.txt": b"10 pushes"}


def listed(path, name):
    return RemoteFile(name, hashlib.sha256(CONTENT[path]).hexdigest(), len(CONTENT[path]), path)


FILES = [listed("a log/exp 12:30.txt", "one/exp 12-30.txt"), listed("b.txt", "two/b.txt")]


class Server(BaseHTTPRequestHandler):
    """Serves CONTENT; `fault` of the server is "404", "cut", "changed" or None, and concerns b.txt only."""

    def do_GET(self):
        path = unquote(self.path[1:])
        self.server.asked.append(path)
        fault = self.server.fault if path == "b.txt" else None
        if fault == "404" or path not in CONTENT:
            self.send_error(404)
            return
        body = CONTENT[path]
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write({"cut": body[:4], "changed": body[::-1]}.get(fault, body))

    def log_message(self, *args):
        pass


@pytest.fixture
def server():
    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as running:
        running.fault, running.asked = None, []
        running.address = f"http://127.0.0.1:{running.server_port}/"
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield running
        running.shutdown()


def test_files_arrive_once(server, tmp_path):
    seen = []
    fetch(FILES, server.address, tmp_path, progress=lambda done, total: seen.append((done, total)))
    assert (tmp_path / "one/exp 12-30.txt").read_bytes() == CONTENT["a log/exp 12:30.txt"]
    assert (tmp_path / "two/b.txt").read_bytes() == CONTENT["b.txt"]
    assert seen == [(0, 9009), (9000, 9009), (9009, 9009)]
    assert len(server.asked) == 2
    fetch(FILES, server.address, tmp_path)
    assert len(server.asked) == 2
    (tmp_path / "two/b.txt").write_text("damaged")
    fetch(FILES, server.address, tmp_path)
    assert server.asked[2:] == ["b.txt"]
    assert (tmp_path / "two/b.txt").read_bytes() == CONTENT["b.txt"]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("404", r"cannot fetch http://\S+/b.txt: the server answers 404 Not Found"),
        ("cut", r"cannot (fetch|use) http://\S+/b.txt: "),
        ("changed", r"cannot use http://\S+/b.txt: it is not the file of 9 bytes that was published"),
    ],
)
def test_what_arrives_wrong_is_not_kept(server, tmp_path, fault, message):
    server.fault = fault
    with pytest.raises(OSError, match=message) as caught:
        fetch(FILES, server.address, tmp_path)
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["exp 12-30.txt"]
    server.fault = None
    fetch(FILES, server.address, tmp_path)
    assert server.asked == ["a log/exp 12:30.txt", "b.txt", "b.txt"]


def test_without_a_server(tmp_path):
    with pytest.raises(OSError, match=r"cannot fetch http://127\.0\.0\.1:9/\S+: no connection to the server") as caught:
        fetch(FILES, "http://127.0.0.1:9/", tmp_path)
    assert "\n" not in str(caught.value)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_the_list_of_published_files():
    files = triangle_files()
    assert len(files) == len({each.file for each in files}) == 118
    assert sum(each.bytes for each in files) == pytest.approx(33.8e6, rel=0.01)
    assert sum(each.file.startswith("three_point_push/") for each in files) == 10
    sensors = {each.file for each in files if "_sensor" in each.file}
    actions = {each.file.replace("_pushaction", "_sensor") for each in files if "_pushaction" in each.file}
    assert sensors == actions
    assert len(sensors) == 54
    assert all(len(each.sha256) == 64 and ":" not in each.file for each in files)


def test_fetched_data_are_found(tmp_path, monkeypatch):
    monkeypatch.delenv("PUSHJAX_DATA", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert find_data() is None
    default_folder().mkdir(parents=True)
    assert find_data() == default_folder()
    monkeypatch.setenv("PUSHJAX_DATA", str(tmp_path))
    assert find_data() == tmp_path


def test_the_command_says_how_far_it_is(server, tmp_path, monkeypatch, capsys):
    """In a pipe too: a line before the first file, and one for each tenth of the bytes."""
    monkeypatch.setattr(download, "SOURCE", server.address)
    monkeypatch.setattr(download, "triangle_files", lambda: FILES)
    monkeypatch.setenv("PUSHJAX_DATA", "elsewhere")
    cli.main(["data", "triangle", "--to", str(tmp_path)])
    printed = capsys.readouterr()
    first, *rest = printed.err.splitlines()
    assert first.startswith(f"pushjax: fetching {len(FILES)} files of 0 MB")
    assert [line.split(": ")[-1] for line in rest] == ["99%", "100%"]  # 9000 of 9009 bytes, and all
    assert printed.out.splitlines() == [
        f"the logs are in {tmp_path}",
        f"PUSHJAX_DATA names another folder, elsewhere: use these with --data {tmp_path}",
    ]
