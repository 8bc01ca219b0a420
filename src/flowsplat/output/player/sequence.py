"""The shots of a clip in one HTML file: the page of each is in it whole, and they play one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jinja2
from markupsafe import Markup

from flowsplat.common.files import write_text
from flowsplat.output.player.page import DATA_OPENING, make_json, make_policy, player_script, read_asset


def write_sequence(path: Path, pages: Sequence[str], shots: Sequence[str], title: str) -> Path:
    """Write the page.

    Args:
        path: the ``.html`` file.
        pages: [S] the page of each shot, as ``write_player`` makes it.
        shots: [S] what the shots are called.
        title: name of the clip.

    Raises:
        InputError: the file cannot be written.
    """
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(read_asset("sequence.html"))
    script = "\n".join(("", '"use strict";', read_asset("sequence.js"), ""))
    page = template.render(
        title=title,
        shots=shots,
        # What a frame may do is bounded by what the page may, too.
        policy=make_policy(script, player_script()),
        pages=[_split(each) for each in pages],
        script=Markup(script),
    )
    write_text(path, page)
    return path


def _split(page: str) -> tuple[Markup, Markup]:
    """Return what stands round the data of a page, as JSON, and the data, which would take far more room as JSON."""
    before, opening, rest = page.partition(DATA_OPENING)
    data, closing, after = rest.partition("</script>")
    return make_json([before + opening, closing + after]), Markup(data)
