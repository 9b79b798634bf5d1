"""Build hook: a package index shows the README without the repository, into which its links are relative.

With `[project.urls] Repository` in pyproject.toml they become absolute, as GitHub and the Hugging Face Hub have them;
without it (the repository has no public address yet) the text stays and the links go.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = r"!\[([^\]]*)\]\((?!https?://)([^)]*)\)"
LINK = r"(?<!!)\[([^\]]*)\]\((?!https?://)([^)]*)\)"


class ReadmeHook(MetadataHookInterface):
    """Leaves no relative link or picture in the README."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field `readme`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = metadata.get("urls", {}).get("Repository", "")
        metadata["readme"] = {"content-type": "text/markdown", "text": without_relative_links(text, repository)}


def without_relative_links(text: str, repository: str) -> str:
    """Markdown whose links lead to the repository's address; without one they are text, and pictures are left out."""
    if not repository:
        return re.sub(LINK, r"\1", re.sub(PICTURE + r"\n", "", text))
    text = re.sub(PICTURE, rf"![\1]({repository}/raw/main/\2)", text)
    return re.sub(LINK, rf"[\1]({repository}/blob/main/\2)", text)
