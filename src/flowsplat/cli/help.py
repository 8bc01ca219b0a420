"""Shorten what tyro prints: help with the usual options only, messages in one line."""

import re

USUAL_OPTIONS = (
    "-h", "-o", "--preset", "--workers", "--memory", "--shard", "--engine", "--status", "--retry", "--only", "--device", "--shots",
    "--start", "--end", "--every", "--max-frames", "--resize", "--holdout", "--mask-click", "--contact", "--cameras.focal",
    "--given.masks", "--train.iterations", "--gaussians", "--render.paths",
)  # fmt: skip
"""The options that --help shows of a command with more than ``SHORT_HELP_OPTIONS`` of them; --help-all shows all."""
SHORT_HELP_OPTIONS = 40
"""Options up to which --help shows all of a command. Chosen by eye."""


def short_help(text: str, command: str) -> str:
    """Return the help of a command as tyro prints it into a file, with the usual options only where there are many."""
    head, *sections = re.split(r"^ (?=\S.*\n -{9})", text, flags=re.M)
    options, usual, kept = 0, 0, [head]
    for section in sections:
        title, *entries = re.split(r"^  (?=-\w|--\w)", section, flags=re.M)
        chosen = [entry for entry in entries if re.split(r"[ ,\n]", entry, maxsplit=1)[0] in USUAL_OPTIONS]
        options, usual = options + len(entries), usual + len(chosen)
        if chosen or not entries:
            kept.append(" " + "  ".join([title, *chosen]).rstrip() + "\n\n")
    short = f"{''.join(kept)}These are {usual} of {options} options. All of them: {command} --help-all\n"
    return short if options > SHORT_HELP_OPTIONS else text


def message_of(box: str) -> str:
    """Return the message in one of tyro's boxes, as one line: of what one may have meant the names only."""
    text: list[str] = []
    meant: list[str] | None = None
    for line in (line.strip("│╭╮╰╯─ \n") for line in box.splitlines()):
        if line.startswith("For full helptext") or line == "Argument helptext:":
            break
        if not line.strip("-"):  # a rule
            continue
        if line == "Perhaps you meant:":
            meant = []
        elif meant is None:
            text.append(line)
        elif line.startswith("-"):
            meant += [name for name in re.findall(r"--[\w.-]+", line)[:1] if name not in meant]
    told = " ".join(text[1:] if len(text) > 1 else text)
    return f"{told}. Perhaps you meant {' or '.join(meant)}." if meant else told
