# SPDX-License-Identifier: Apache-2.0
"""Rows of figures, which every study makes: by tasks in processes, as CSV, as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import fields
from typing import Any, TypeVar

from joblib import Parallel, delayed
from rich.table import Table

# Called with how many are done, and how many there are.
Progress = Callable[[int, int], None]
_Task = TypeVar("_Task")
_Answer = TypeVar("_Answer")


class Steps:
    """So many steps, of which a progress bar is told when one is done."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._total, self._progress, self._done = total, progress, 0

    def done(self) -> None:
        """One more."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)


def in_processes(
    function: Callable[[_Task], _Answer],
    tasks: Sequence[_Task],
    jobs: int | None,
    progress: Progress | None,
) -> list[_Answer]:
    """The answers to all tasks, in the order in which they are found.

    jobs: processes, -1 for one a core; None for what a `joblib.parallel_backend` around the call
    says, which may be a cluster, else one.
    """
    parallel = Parallel(n_jobs=jobs, return_as="generator_unordered")
    # Closed on whatever way out, so that no process goes on without a reader.
    answers: list[_Answer] = []
    steps = Steps(len(tasks), progress)
    with closing(parallel(delayed(function)(task) for task in tasks)) as arriving:
        for answer in arriving:
            answers.append(answer)
            steps.done()
    return answers


def field_names(row: Any) -> list[str]:
    """The names of a dataclass's fields, which are the columns of its CSV."""
    return [field.name for field in fields(row)]


def as_csv(columns: Sequence[str], rows: Iterable[Iterable[object]], digits: int = 4) -> str:
    """A line for each row: None is empty, True is 1, numbers have so many significant digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(value, digits) for value in row])
    return text.getvalue()


def _cell(value: object, digits: int) -> object:
    match value:
        case bool():
            return int(value)
        case float():
            return f"{value:.{digits}g}"
    return value


def text_table(words: Iterable[str], numbers: Iterable[str], **settings: Any) -> Table:
    """An empty table for a terminal, with columns of words, then of numbers."""
    table = Table(box=None, **settings)
    for heading in words:
        table.add_column(heading, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table
