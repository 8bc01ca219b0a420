"""What is read of a command line before it is parsed: the defaults of options depend on it."""

from collections.abc import Sequence


def value_of(arguments: Sequence[str], option: str) -> str | None:
    """What follows an option, behind a space or =; None where it is not among them."""
    for k, argument in enumerate(arguments):
        if argument == option and k + 1 < len(arguments):
            return arguments[k + 1]
        if argument.startswith(option + "="):
            return argument[len(option) + 1 :]
    return None
