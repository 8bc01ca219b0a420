"""Errors that are written for the person at the keyboard."""

MAX_MESSAGE_CHARACTERS = 1000
"""Characters of a message. Chosen by eye."""


class InputError(Exception):
    """Something the user gave cannot be used.

    The message is one line: what was wrong with which input, and what to do about it. The command line prints it
    without a traceback and exits with code 2. Names in it may come from anywhere: whatever they hold, it stays one line.
    """

    def __init__(self, message: str):
        super().__init__(one_line(message))


class WritingError(InputError):
    """A file or folder cannot be written: what is wrong is the place to write to, and nothing that was read."""


class InUseError(InputError):
    """Another process has what is wanted; when that has ended, it can be had."""


class SplitError(RuntimeError):
    """Code that may only see training frames asked for a held-out one. Always a bug, never the user's fault."""


def describe_install(extra: str) -> str:
    """Return what to type for an extra of flowsplat that is not installed: no package index has flowsplat before its first release.

    >>> describe_install("view")
    "pip install -e '.[view]' in flowsplat's repository"
    """
    return f"pip install -e '.[{extra}]' in flowsplat's repository"


def one_line(text: str) -> str:
    """``text`` as it can be shown on one line: escapes for what is not printable, and of what is very long both ends."""
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in _both_ends(text))
    return _both_ends(shown)


def _both_ends(text: str) -> str:
    return (
        text
        if len(text) <= MAX_MESSAGE_CHARACTERS
        else f"{text[: MAX_MESSAGE_CHARACTERS * 3 // 4]} ... {text[5 - MAX_MESSAGE_CHARACTERS // 4 :]}"
    )


def first_line(error: BaseException) -> str:
    """Return what an error says, on one line that fits into a sentence; its kind where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".: ")
