"""docs/troubleshooting.md has each error message that a person may meet."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ERRORS = {"UserError", "CalibrationError", "DepthError", "ArmStoppedError", "reported", "_reported_part"}
"""What is called with a message; `reported` and `_reported_part` put a library's reason behind it."""


def template(node: ast.expr) -> str:
    """A message with … for what is filled in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(map(template, parts))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return template(left) + template(right)
        case _:
            return "…"


def messages() -> Iterator[tuple[Path, str]]:
    for path in sorted((ROOT / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ERRORS and node.args:
                text = template(node.args[0])
                if re.search(r"\w", text):  # another error's message is passed on
                    yield path, text


def rows() -> list[re.Pattern[str]]:
    """What each message of the page's tables matches: ... stands for anything, at the end as well."""
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    quoted = [
        text for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE) for text in re.findall(r"`([^`]*)`", row)
    ]
    return [re.compile(".*".join(map(re.escape, re.split(r"\.\.\.(?!\.)", text))), re.DOTALL) for text in quoted]


@pytest.mark.parametrize(("path", "message"), messages(), ids=lambda value: getattr(value, "name", value))
def test_the_page_says_what_to_do(path, message):
    assert any(row.match(message) for row in rows()), f"docs/troubleshooting.md lacks a row for {path}: {message}"


def test_the_messages_are_found():
    assert len(list(messages())) > 200
