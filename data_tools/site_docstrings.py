"""An extension of Griffe, which reads the docstrings for the site: what they write as reStructuredText, in Markdown."""

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|data|mod|meth|attr):`[~.]?([^`]+)`")
BORDER = re.compile(r" *=+(?: +=+)+ *")


class MarkdownDocstrings(griffe.Extension):
    """Rewrites every docstring when its object has been loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite one."""
        if obj.docstring is not None:
            obj.docstring.value = to_markdown(obj.docstring.value)


def to_markdown(docstring: str) -> str:
    """Return a docstring whose roles are code, whose tables are preformatted, and whose ``::`` is a colon."""
    lines = []
    lines_of_docstring = ROLE.sub(r"`\1`", docstring).split("\n")
    borders = [number for number, line in enumerate(lines_of_docstring) if BORDER.fullmatch(line)]
    for number, line in enumerate(lines_of_docstring):
        if borders and number in (borders[0], borders[-1]):
            fence = ["", "```text"] if number == borders[0] else ["```", ""]
            lines += [*fence, line] if number == borders[0] else [line, *fence]
        else:
            lines.append(re.sub(r"(^|\S)\s*::$", lambda match: f"{match[1]}:" if match[1] else "", line))
    return "\n".join(lines)
