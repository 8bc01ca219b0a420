"""The tables of motion models, scene by scene, and of neural fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from flowsplat_benchmarks.ablations.verdicts import EVEN_DECIBELS
from flowsplat_benchmarks.datasets.cases import OWN_SUFFIX
from flowsplat_benchmarks.fields import benchmark as fields_benchmark
from flowsplat_benchmarks.models.lineup import BASE, LINEUP
from flowsplat_benchmarks.models.report import CRITERIA, name_best
from flowsplat_benchmarks.results.cells import CLIP_SIDE, FIELD_TIMES, MODEL_SCENES, RENDERED, name_field
from flowsplat_benchmarks.results.rows import Records, Row, Shown, add_missing, make_table, name_of
from flowsplat_benchmarks.tables import Table, text


def list_model_tables(records: Records) -> list[Table]:
    """Return which motion model is best where, what each does on each scene, and fields beside ``default``."""
    return [_tabulate_best(records), *(_tabulate_models(name, records) for name in MODEL_SCENES), _tabulate_fields(records)]


def _tabulate_best(records: Records) -> Table:
    """Tabulate which model is the best of each scene, among those that were measured at the newest commit of the series."""
    rows = []
    for scene in MODEL_SCENES:
        base = records.row("models", scene, BASE.variant.name)
        measured = [each for each in base.records if each.failure is None]
        if not measured:
            continue
        of = {
            name: Row([each for each in records.row("models", scene, name).records if each.commit == measured[-1].commit])
            for name in (entrant.variant.name for entrant in LINEUP)
        }
        cells = []
        for column, sign in CRITERIA:
            found = {name: value for name, row in of.items() if (value := row.value(*column.path)) is not None}
            cells.append(name_best(found, sign, column.digits))
        rows.append((_title_scene(scene), *cells))
    note = (
        f"In brackets: the difference from `series`, which stands where no other is {EVEN_DECIBELS:g} dB better. Means over the "
        "seeds that the tables below tell; of one seed nobody knows what another changes."
    )
    header = ("", *(column.header for column, _ in CRITERIA))
    return Table("Which is best where", note if rows else add_missing("", ["all"], is_all=True), header, rows)


def _title_scene(scene: str) -> str:
    title = name_of(scene.removesuffix(OWN_SUFFIX)) + (", own priors" if scene.endswith(OWN_SUFFIX) else "")
    return title[0].upper() + title[1:]


def _tabulate_models(scene: str, records: Records) -> Table:
    rows = [(entrant.variant.label, records.row("models", scene, entrant.variant.name)) for entrant in LINEUP]
    rendered = scene.removesuffix(OWN_SUFFIX)
    is_clip, has_own = rendered not in RENDERED, rendered != scene
    columns: tuple[Shown | tuple[str, Callable[[Row], str | None]], ...] = (
        Shown("held-out times (inside)", (("times", "psnr"), ("times", "moving", "psnr"))),
        *(
            (Shown("gap of 1", (("gaps", "1", "psnr"),)), Shown("of 3", (("gaps", "3", "psnr"),)),
             Shown("of 5", (("gaps", "5", "psnr"),)),
             Shown("end", (("gaps", "end", "psnr"),)))
            if is_clip
            else (Shown("from aside (inside)", (("views", "psnr"), ("views", "moving", "psnr"))),
                  Shown("flow inside, px", (("flow", "moving", "mean"),)), Shown("tracks, %", (("tracks", "moving", "median"),)))
        ),
        Shown("MB", (("parameters", "bytes"),), 0, 1e-6),
        ("times as long", partial(_times_as_long, records.row("models", scene, BASE.variant.name))),
    )  # fmt: skip
    priors = "own" if has_own else "true"
    note = (
        f"At {CLIP_SIDE} pixels, given masks." if is_clip else f"480x270, {priors} priors; *aside*: 36 images by held-out cameras."
    )
    return make_table(_title_scene(scene), note, rows, columns, "motion", strong=(0,))


def _tabulate_fields(records: Records) -> Table:
    """Tabulate fields beside ``default``, which is in the record of each."""
    fields = [
        (f"{label}, {'as long as flowsplat' if times == 1 else f'{times} times as long'}", name_field(field, times))
        for field, label in (("t-nerf", "T-NeRF"), ("hypernerf", "HyperNeRF"))
        for times in FIELD_TIMES
    ]
    rows = [(label, records.row("fields", "bear", variant)) for label, variant in fields]
    beside = [replace(record, result=default) for record in rows[0][1].records if (default := (record.result or {}).get("default"))]
    columns = (
        Shown("PSNR (inside)", (("psnr",), ("moving",))), Shown("SSIM", (("ssim",),), 3), Shown("steps", (("iterations",),), 0),
        Shown("training, s", (("seconds", "train"),), 0), Shown("an image, s", (("image_seconds",),)),
    )  # fmt: skip
    note = (
        f"Bear at {fields_benchmark.SIZE} pixels of width, one frame in ten held out: two neural fields from their published "
        "architecture, trained for as long as `default` takes on the same processor, and for ten times as long. "
        "How many steps fit is planned from the time of the first, so the seconds can be fewer."
    )
    return make_table("Fields", note, [("flowsplat, `default`", Row(beside, records.used)), *rows], columns, "", strong=(0,))


def _times_as_long(base: Row, row: Row) -> str | None:
    """Return how many times as long as the series a model trains at the same commit."""
    for record in reversed(row.records):
        same = [each for each in base.records if (each.commit, each.seed) == (record.commit, record.seed)]
        own, of_base = (Row([each]).value("seconds", "train") for each in (record, same[-1])) if same else (None, None)
        if own and of_base:
            row.note_commit(record.commit)
            return text(own / of_base, 1)
        if (told := Row([record]).value("relative_time")) is not None:
            row.note_commit(record.commit)
            return text(told, 1)
    return None
