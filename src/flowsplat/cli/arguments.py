"""What is read of a command line before it is parsed: the defaults of options depend on it."""

from collections.abc import Sequence

from flowsplat.common.progress import say


def with_present_names(arguments: Sequence[str]) -> list[str]:
    """The arguments with the names that options have now; a line says which had another one."""
    from flowsplat.common.settings import renamed_settings
    from flowsplat.pipeline.config import RunConfig, option_of

    renamed = {option_of(before): option_of(now) for before, now in renamed_settings(RunConfig).items()}
    found = []
    for argument in arguments:
        option, equals, value = argument.partition("=")
        now = renamed.get(option.replace("_", "-"))
        if now is not None:
            say(f"{option} is called {now} now.")
        found.append(argument if now is None else now + equals + value)
    return found


def value_of(arguments: Sequence[str], option: str) -> str | None:
    """What follows an option, behind a space or =; None where it is not among them."""
    for k, argument in enumerate(arguments):
        if argument == option and k + 1 < len(arguments):
            return arguments[k + 1]
        if argument.startswith(option + "="):
            return argument[len(option) + 1 :]
    return None
