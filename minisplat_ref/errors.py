"""The one exception that means: the input is wrong, and here is the way out."""


class InputError(ValueError):
    """Bad input. The message is one line that names the culprit and what to do; the command line exits with code 2."""
