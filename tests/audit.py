"""Ask for known vulnerabilities of the versions in constraints.txt; part of `make check`.

They are asked of OSV (https://osv.dev), which collects the advisories of PyPA, GitHub and others, in one request. It
ends with 1 if there are any. Where OSV cannot be reached it says so in a line and ends with 0: without the network, an
audit has no result.
"""

import json
import sys
from collections.abc import Iterator
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from packaging.utils import canonicalize_name

OSV = "https://api.osv.dev"
CONSTRAINTS = Path(__file__).parent.parent / "constraints.txt"
TIMEOUT = 10
"""Seconds without an answer after which OSV counts as unreachable."""


def pins(constraints: Path) -> list[tuple[str, str]]:
    """Names and versions of a file of lines name==version."""
    lines = constraints.read_text(encoding="utf-8").splitlines()
    parts = [line.partition("==") for line in lines if not line.startswith("#")]
    return [(canonicalize_name(name), version) for name, _, version in parts if version]


def advisories(packages: list[tuple[str, str]], url: str) -> Iterator[str]:
    """Yield a line for each advisory about one of the packages in its version.

    Raises:
        ConnectionError: if there is no answer, or one that is not OSV's.
    """
    queries = [{"package": {"ecosystem": "PyPI", "name": name}, "version": version} for name, version in packages]
    while queries:
        more = []  # a long answer comes in pages
        for query, result in zip(queries, _ask(queries, url), strict=True):
            for each in result.get("vulns", []):
                yield f"{query['package']['name']} {query['version']}: https://osv.dev/{each['id']}"
            if "next_page_token" in result:
                more.append({**query, "page_token": result["next_page_token"]})
        queries = more


def _ask(queries: list[dict], url: str) -> list[dict]:
    """One result for each query."""
    body = json.dumps({"queries": queries}).encode()
    request = Request(f"{url}/v1/querybatch", body, {"Content-Type": "application/json"})
    try:
        with urlopen(request, timeout=TIMEOUT) as answer:
            return json.load(answer)["results"]
    except HTTPError as error:
        if error.code == 400:  # OSV does not understand the question, which is this file's fault
            raise
        raise ConnectionError(error) from error
    except (OSError, HTTPException, ValueError, KeyError, TypeError) as error:  # or a proxy's page instead of an answer
        raise ConnectionError(error) from error


def main(url: str = OSV) -> int:
    """Print what is known. Returns the exit code."""
    packages, n_found = pins(CONSTRAINTS), 0
    try:
        for line in advisories(packages, url):
            print(line)
            n_found += 1
        print(f"{n_found} advisories about {len(packages)} pinned packages (osv.dev)")
    except ConnectionError as error:
        print(f"The pinned packages are NOT AUDITED: no advisories from {url} ({error})")
    return 1 if n_found else 0


if __name__ == "__main__":
    sys.exit(main())
