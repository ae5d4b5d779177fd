"""Progress bars, and that of a mapping run: a listener of the pipeline."""

from types import TracebackType
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from taichi_mrf.mapping.intake import Added
from taichi_mrf.mapping.pipeline import Event, FrameOffered, KeyframeRefined, KeyframeSwept

Bar = TypeVar("Bar", bound="TransientBar")


class _RateColumn(ProgressColumn):
    """How many keyframes pass in a second."""

    def render(self, task: Task) -> Text:
        rate = task.fields["keyframes"] / task.elapsed if task.elapsed else 0.0
        return Text(f"{rate:.1f} keyframes/s" if rate else "")


class TransientBar:
    """A bar on a terminal that is gone when the block ends; silent where the output is not a terminal."""

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)

    def count(self, done: int, total: int) -> None:
        """Move the bar of a run with a single stage."""
        if not self._progress.tasks:
            self._progress.add_task("", total=total)
        self._progress.update(self._progress.tasks[0].id, completed=done, total=total)

    def __enter__(self: Bar) -> Bar:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.stop()


class ProgressBar(TransientBar):
    """Shows one stage at a time on a terminal; silent where the output is not one."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            console,
            TextColumn("{task.description:9}"),
            BarColumn(),
            MofNCompleteColumn(),
            _RateColumn(),
            TimeRemainingColumn(),
        )
        self._stage = ""
        self._task: TaskID | None = None

    def listen(self, event: Event) -> None:
        """Show what the pipeline has just done."""
        if isinstance(event, FrameOffered):
            self.advance("Adding", event.number, event.frames, int(isinstance(event.answer, Added)))
        elif isinstance(event, KeyframeSwept):
            done = (event.sweep - 1) * event.keyframes + event.number
            self.advance("Inferring", done, event.sweeps * event.keyframes, 1)
        elif isinstance(event, KeyframeRefined):
            done = (event.round - 1) * event.keyframes + event.number
            self.advance("Aligning", done, event.rounds * event.keyframes, 1)

    def advance(self, stage: str, done: int, total: int, keyframes: int = 0) -> None:
        """Move the bar of a stage, which takes the place of the stage before."""
        if stage != self._stage or self._task is None:
            if self._task is not None:
                self._progress.remove_task(self._task)
            self._stage, self._task = stage, self._progress.add_task(stage, total=total, keyframes=0)
        counted = self._progress.tasks[0].fields["keyframes"] + keyframes
        self._progress.update(self._task, completed=done, total=total, keyframes=counted)
