"""The README as the package index shows it: hatchling calls this when it builds the wheel or the source distribution.

In the repository links are relative, so that they lead to the files of the branch that is read. The index has no such
files: there links lead to those of the released version in the repository that ``[project.urls]`` names, and images are
loaded from it. Without a repository a link becomes its text, and an image is left out.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

REPOSITORY = "Repository"  # of [project.urls]
LINK = re.compile(r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>(?!https?:|#|mailto:)[^)]+)\)")


class ReadmeHook(MetadataHookInterface):
    """Sets ``readme``, which pyproject.toml names as dynamic."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the README, without relative links."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = metadata.get("urls", {}).get(REPOSITORY)
        text = without_relative_links(text, repository, metadata["version"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def without_relative_links(text: str, repository: str | None, version: str) -> str:
    """Return Markdown whose links and images are absolute.

    Parameters
    ----------
    text : str
        Markdown.
    repository : str, optional
        Address of a repository on GitHub; without one, links become their texts, and images are left out.
    version : str
        Its tag is ``vVERSION``.
    """

    def rewrite(match: re.Match[str]) -> str:
        is_image, target = bool(match["image"]), match["target"].removeprefix("./")
        if repository is None:
            return "" if is_image else match["text"]
        kind = "raw" if is_image else "blob"
        return f"{match['image']}[{match['text']}]({repository.rstrip('/')}/{kind}/v{version}/{target})"

    return LINK.sub(rewrite, text).lstrip("\n")
