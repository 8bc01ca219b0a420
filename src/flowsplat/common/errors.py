"""Errors that are written for the person at the keyboard."""


class InputError(Exception):
    """Something the user gave cannot be used.

    The message is one line: what was wrong with which input, and what to do about it. The command line prints it
    without a traceback and exits with code 2.
    """


class SplitError(RuntimeError):
    """Code that may only see training frames asked for a held-out one. Always a bug, never the user's fault."""


def first_line(error: BaseException) -> str:
    """What an error says, on one line that fits into a sentence; its kind where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".: ")
