"""The one exception for bad input, whose message states the remedy, and the warning for doubtful input."""

LINE_MAX = 1000  # characters of a message; the middle of a longer one is left out
_TAIL = 250  # characters kept at the end, which says how to fix the input


class InputError(ValueError):
    """Bad input. The message is one line that names the culprit and what to do; the command line exits with code 2.

    Messages quote names and values from files. Characters that would end the line or act on a terminal are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class InputWarning(UserWarning):
    """Input that is used, though perhaps not as intended; one line, which the command line prints before it continues.

    A message that quotes text from a file has been through :func:`one_line`.
    """


def one_line(message: str) -> str:
    """Return a message as one line of at most LINE_MAX printable characters."""
    text = "".join(char if char.isprintable() else repr(char)[1:-1] for char in message)
    return text if len(text) <= LINE_MAX else f"{text[: LINE_MAX - _TAIL - 5]} ... {text[-_TAIL:]}"
