"""The one exception that means: the input is wrong, and here is the way out; and its milder form."""

LINE_MAX = 1000  # characters of a message; what lies in the middle of a longer one is left out
_TAIL = 250  # characters kept at the end, where the way out stands


class InputError(ValueError):
    """Bad input. The message is one line that names the culprit and what to do; the command line exits with code 2.

    Messages quote names and values from files. Characters that would end the line or act on a terminal are escaped.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class InputWarning(UserWarning):
    """Input that is used, though perhaps not as it was meant; one line, which the command line prints before going on.

    The message has been through :func:`one_line`, if it quotes what comes from a file.
    """


def one_line(message: str) -> str:
    """Return a message on one line of LINE_MAX characters at most, all of them printable."""
    text = "".join(char if char.isprintable() else repr(char)[1:-1] for char in message)
    return text if len(text) <= LINE_MAX else f"{text[: LINE_MAX - _TAIL - 5]} ... {text[-_TAIL:]}"
