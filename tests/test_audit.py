"""The audit of the pinned versions, with a server on this machine that answers as OSV does."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.error import HTTPError

import pytest

from tests import audit


class Advisories(BaseHTTPRequestHandler):
    """OSV's `POST /v1/querybatch`: a result for each query, in pages of one advisory."""

    known: dict[tuple[str, str], list[str]]
    status = 200
    body: bytes | None = None

    def do_POST(self):
        assert self.path == "/v1/querybatch"
        queries = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["queries"]
        content = self.body or json.dumps({"results": [self.result(**query) for query in queries]}).encode()
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(content)

    def result(self, package, version, page_token="0"):
        assert package["ecosystem"] == "PyPI"
        page, found = int(page_token), self.known.get((package["name"], version), [])
        more = {"next_page_token": str(page + 1)} if page + 1 < len(found) else {}
        return {"vulns": [{"id": found[page], "modified": "2026-01-01T00:00:00Z"}], **more} if found else {}

    def log_message(self, *_):
        pass


@pytest.fixture
def osv():
    """The class that answers, of a server that is running; and its address."""
    answers = type("Answers", (Advisories,), {"known": {}})
    with ThreadingHTTPServer(("127.0.0.1", 0), answers) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield answers, f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture
def constraints(tmp_path, monkeypatch):
    path = tmp_path / "constraints.txt"
    path.write_text("# a comment\nJinja2==2.4.1\ntyping_extensions==4.16.0\n")
    monkeypatch.setattr(audit, "CONSTRAINTS", path)


def test_known_vulnerabilities_fail_and_are_named(osv, constraints, capsys):
    answers, url = osv
    answers.known = {("jinja2", "2.4.1"): ["GHSA-1", "PYSEC-2"], ("typing-extensions", "4.15.0"): ["GHSA-3"]}
    assert audit.main(url) == 1
    assert capsys.readouterr().out.splitlines() == [
        "jinja2 2.4.1: https://osv.dev/GHSA-1",
        "jinja2 2.4.1: https://osv.dev/PYSEC-2",
        "2 advisories about 2 pinned packages (osv.dev)",
    ]


def test_without_any_it_passes(osv, capsys):
    _, url = osv
    assert audit.main(url) == 0
    n_pins = len(audit.pins(audit.CONSTRAINTS))
    assert n_pins > 100
    assert capsys.readouterr().out == f"0 advisories about {n_pins} pinned packages (osv.dev)\n"


@pytest.mark.parametrize("answer", [(404, b""), (503, b"busy"), (200, b"<html>Please log in</html>"), (200, b"[1]")])
def test_what_does_not_answer_as_osv_is_said_in_a_line(osv, constraints, capsys, answer):
    answers, url = osv
    answers.status, answers.body = answer
    assert audit.main(url) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"The pinned packages are NOT AUDITED: no advisories from {url} (")


def test_no_server_is_said_in_a_line(osv, constraints, capsys):
    with ThreadingHTTPServer(("127.0.0.1", 0), Advisories) as server:
        url = f"http://127.0.0.1:{server.server_port}"
    assert audit.main(url) == 0
    assert "NOT AUDITED" in capsys.readouterr().out


def test_what_was_found_before_the_connection_was_lost_counts(osv, constraints, capsys):
    answers, url = osv
    answers.known = {("jinja2", "2.4.1"): ["GHSA-1", "GHSA-2"]}
    original = answers.result

    def lost(self, package, version, page_token="0"):
        if page_token == "1":
            raise ConnectionResetError
        return original(self, package, version, page_token)

    answers.result = lost
    assert audit.main(url) == 1
    assert "NOT AUDITED" in capsys.readouterr().out


def test_a_wrong_question_is_an_error(osv, constraints):
    answers, url = osv
    answers.status = 400
    with pytest.raises(HTTPError):
        audit.main(url)
