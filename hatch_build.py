"""Build hook: the README inside the wheel names the repository's files without linking to them.

The links are relative to the repository, and a package index shows the README without it.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = r"!\[[^\]]*\]\((?!https?://)[^)]*\)\n"
LINK = r"\[([^\]]*)\]\((?!https?://)[^)]*\)"


class ReadmeHook(MetadataHookInterface):
    """Takes relative links and pictures out of the README."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field `readme`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = re.sub(LINK, r"\1", re.sub(PICTURE, "", text))
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
