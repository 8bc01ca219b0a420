"""Rows of the results pages: what several records of the same cell say, and at which commit that was measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.evaluation.scores import mean_of, pick
from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.ablations.verdicts import Effect, Run, effect
from flowsplat_benchmarks.priors.scenes import TUNED
from flowsplat_benchmarks.results.records import Record
from flowsplat_benchmarks.tables import TUNED_MARK, Table, text

NOT_MEASURED, FAILED, MISSING = "not measured", "failed", "Not measured yet"
MEASURED_AT = "measured at"
FIGURES_OF = {"refined": "ours", "training_frames": "ours", "ssim": "psnr", "moving": "psnr", "covisible": "psnr"}
"""Figures of a result that stand beside others in a table, and are taken from no other commit than those."""
PRIORS = "figures"
"""Where the figures of priors are, each of which may be of another commit."""
STAGES = ("cameras", "flow", "masks", "tracks", "depth", "train", "evaluate")
"""Of a run, of which the results pages tell the seconds."""
Path = tuple[str, ...]
"""The keys of a figure in a result."""


class Records:
    """Records by what they are of; later ones are newer."""

    def __init__(self, records: Iterable[Record]) -> None:
        self.all = list(records)
        self.used: dict[str, None] = {}
        """Commits at which figures were measured that rows were asked for."""

    def row(self, benchmark: str, scene: str, variant: str = "") -> Row:
        """Return the row of a cell with all its seeds."""
        key = benchmark, scene, variant
        return Row([each for each in self.all if (each.benchmark, each.scene, each.variant) == key], self.used)

    def of(self, benchmark: str) -> list[Record]:
        """Return all records of a benchmark."""
        return [record for record in self.all if record.benchmark == benchmark]

    def machines(self) -> Iterator[tuple[str, str]]:
        """Yield each of the commits in ``used`` with the machines on which it was measured."""
        for commit in self.used:
            yield commit, "; ".join(dict.fromkeys(_where(each) for each in self.all if each.commit == commit))


class Row:
    """What the records of one cell say, all seeds together."""

    def __init__(self, records: Sequence[Record], used: dict[str, None] | None = None) -> None:
        self.records = records
        self._used = {} if used is None else used
        self.commits: dict[str, None] = {}
        """At which the figures were measured that were asked for."""
        self._seeds = 0

    def value(self, *path: str) -> float | None:
        """Return a figure: the mean over the seeds at the newest commit that has figures of this kind; None where it is not there.

        Raises:
            InputError: it is no number.
        """
        kind = path if path[0] == PRIORS else (FIGURES_OF.get(path[0], path[0]),)
        for record in reversed(self.records):
            if record.failure is not None or pick(record.result or {}, *kind) is None:
                continue
            if figure(record, path) is None:
                return None
            by_seed = {each.seed: figure(each, path) for each in self.records if each.commit == record.commit}
            self.note_commit(record.commit)
            self.note_seeds(sum(value is not None for value in by_seed.values()))
            return mean_of(by_seed.values())
        return None

    def note_commit(self, commit: str) -> None:
        """Remember that a figure was measured at a commit."""
        self.commits[commit] = self._used[commit] = None

    def note_seeds(self, count: int) -> None:
        """Remember that a figure is a mean over so many seeds."""
        self._seeds = max(self._seeds, count)

    def failures(self) -> list[str]:
        """Return what the newest record of each seed says of its failure, where it failed."""
        newest = {record.seed: record for record in self.records}
        self._used.update(dict.fromkeys(each.commit for each in newest.values() if each.failure is not None))
        return [f"seed {seed} failed at {each.commit}: {each.failure}" for seed, each in newest.items() if each.failure is not None]

    def status(self) -> str:
        """Return at which commit it was measured, with how many seeds where there are several, and what failed."""
        at = " and ".join(self.commits)
        seeds = f", {self._seeds} seeds" if self._seeds > 1 else ""
        return "; ".join(one_line(part) for part in (f"{at}{seeds}" if at else "", *self.failures()) if part)


def figure(record: Record, path: Path) -> float | None:
    """Return a figure of a record; None where it has none.

    Raises:
        InputError: it is no number.
    """
    value: Any = record.result or {}
    if record.failure is not None:
        return None
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(
            f"The record of {record.benchmark} {record.scene} {record.variant} is damaged: {'.'.join(path)} is no number."
        )
    return float(value)


def _where(record: Record) -> str:
    threads = "" if record.threads is None else f", {record.threads} thread{'' if record.threads == 1 else 's'}"
    return f"{record.machine}{threads}"


def tell_whole_run(row: Row) -> str | None:
    """Return the seconds of a run, from the newest record that has some: as they were taken, or of its stages together, without
    reading and videos; None where there are none, or where a stage that every run has is missing, as in a continued one."""
    for record in reversed(row.records):
        whole = figure(record, ("whole_seconds",))
        stages = {stage: value for stage in STAGES if (value := figure(record, ("seconds", stage))) is not None}
        is_complete = all(stage in stages for stage in STAGES if stage != "masks")  # which can be given
        if whole is not None or is_complete:
            row.note_commit(record.commit)
            return text(whole, 0) if whole is not None else f"{text(sum(stages.values()), 0)} (stages)"
    return None


def one_line(words: str) -> str:
    """Return words that a cell of a table can hold."""
    return " ".join(words.split()).replace("|", "\\|").replace("<", "&lt;")


@dataclass(frozen=True)
class Shown:
    """A column: a figure, and others in brackets behind it.

    Attributes:
        header: what stands over it.
        paths: of the figures.
        digits: behind the point.
        factor: by which they are multiplied.
    """

    header: str
    paths: tuple[Path, ...]
    digits: int = 2
    factor: float = 1.0

    def cell(self, row: Row) -> str | None:
        """Return the cell of a row; None where it has nothing."""
        values = [row.value(*path) for path in self.paths]
        if values[0] is None:
            return None
        first, *others = (None if value is None else text(self.factor * value, self.digits) for value in values)
        told = [other for other in others if other is not None]
        return f"{first} ({', '.join(told)})" if told else first


Cell = Callable[[Row], str | None]


def make_table(
    title: str, note: str, rows: Sequence[tuple[str, Row]], columns: Sequence[Shown | tuple[str, Cell]], first: str = "",
    strong: Sequence[int] = (),
) -> Table:  # fmt: skip
    """Return a table with a row each, and behind it at which commit it was measured; those of which there is nothing are named
    in its note.

    Args:
        columns: figures, or a header and what writes the cell of a row.
        first: what stands over the names of the rows.
        strong: which of the rows are bold.
    """
    headers = [column.header if isinstance(column, Shown) else column[0] for column in columns]
    lines: list[tuple[str, ...]] = []
    bold, missing = [], []
    for k, (name, row) in enumerate(rows):
        cells = [column.cell(row) if isinstance(column, Shown) else column[1](row) for column in columns]
        if all(cell is None for cell in cells):
            if not row.failures():
                missing.append(name)
                continue
            cells[0] = FAILED
        if k in strong:
            bold.append(len(lines))
        lines.append((name, *(NOTHING if cell is None else cell for cell in cells), row.status() or NOTHING))
    return Table(title, add_missing(note, missing, not lines), (first, *headers, MEASURED_AT), lines, tuple(bold))


def add_missing(note: str, names: Sequence[str], is_all: bool = False) -> str:
    """Return the note of a table with the rows of which nothing is measured, where there are some, as a paragraph of its own.

    Args:
        is_all: whether the table has no other rows.

    >>> add_missing("", ["bear, *tuned*, own masks", "camel"])
    'Not measured yet: bear, own masks; camel.'
    >>> add_missing("", ["camel"], is_all=True)
    'Not measured yet: all of it.'
    """
    told = "all of it" if is_all else "; ".join(name.replace(f", {TUNED_MARK}", "") for name in names)
    return "\n\n".join(part for part in (note, f"{MISSING}: {told}." if names else "") if part)


def name_of(scene: str) -> str:
    """Return a scene with a mark where settings were chosen on it."""
    return f"{scene}, {TUNED_MARK}" if scene in TUNED else scene


def compare(
    records: Records, benchmark: str, scenes: Sequence[str], pair: tuple[str, str], path: Path
) -> tuple[Effect | None, Row]:
    """Return the differences of a variant from its base, each of two records of the same scene, seed and commit.

    Args:
        pair: the variant and its base.

    Returns:
        the differences, and the row of the variant, which knows at which commits they were measured.
    """
    found: dict[Run, float] = {}
    commits: dict[Run, str] = {}
    row = Row([record for scene in scenes for record in records.row(benchmark, scene, pair[0]).records], records.used)
    for record in row.records:
        value = figure(record, path)
        bases = [
            each
            for each in records.row(benchmark, record.scene, pair[1]).records
            if (each.seed, each.commit) == (record.seed, record.commit) and figure(each, path) is not None
        ]
        if value is None or not bases:
            continue
        base = figure(bases[-1], path)
        assert base is not None
        found[record.scene, record.seed] = value - base
        commits[record.scene, record.seed] = record.commit
    # Scenes that were measured at other commits do not come into the mean.
    order = [each.commit for each in records.all]
    newest = max(commits.values(), key=lambda commit: len(order) - order[::-1].index(commit), default=None)
    found = {run: value for run, value in found.items() if commits[run] == newest}
    if newest is not None:
        row.note_commit(newest)
    row.note_seeds(len({seed for _, seed in found}))
    return effect(found, dict.fromkeys(found, 0.0)), row
