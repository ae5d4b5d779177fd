"""A tuning session: takes parameters from a person or the search, and sends maps and scores to the page.

One thread does all of it, because Taichi has one owner. A try has two passes, the first with a part of the
pixels. Requests are looked at between two keyframes: newer parameters end the present try at once, so that
the newest slider values are always the ones being tried.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.errors import ConfigError, TaichiMRFError
from taichi_mrf.session.link import Link
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.outbox import merged
from taichi_mrf.session.session_core import Policy, SessionCore
from taichi_mrf.system import runtime
from taichi_mrf.system.atomic import write_text
from taichi_mrf.tune.held_out_pictures import HeldOutPictures, residuals_of
from taichi_mrf.tune.history import BEST_FILE, Attempt, History
from taichi_mrf.tune.search import Search
from taichi_mrf.tune.trial import Trial, contenders, judge_unseen, run_trial, verdict_lines
from taichi_mrf.tune.working_set import WorkingSet, coarse_stride, read_working_set
from taichi_mrf.viewer.messages import File, Hello, Listening, Notice, Quit
from taichi_mrf.viewer.tune import messages as t
from taichi_mrf.viewer.tune.messages import By, FrameChoice


class TuneSession(SessionCore):
    """Works on one sequence. ``history`` holds all tries; ``frames`` is the working set."""

    EXPECTED = TaichiMRFError

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        choice: FrameChoice,
        link: Link,
        policy: Policy,
        *,
        search: Search | None = None,
        listening: Callable[[Listening], None] = lambda where: None,
        tried: Callable[[Attempt], None] = lambda attempt: None,
        judged: Callable[[list[str]], None] = lambda verdict: None,
    ) -> None:
        """Reads the working set and sends it to the page. ``search`` is carried out first. ``listening`` is
        called with the address of the page, ``tried`` after each try, ``judged`` with the verdict, line by
        line, once the search has ended. Raises TaichiMRFError."""
        super().__init__(link, policy)
        self._dataset, self._config = dataset, config
        self._tried, self._judged = tried, judged
        self._newer = 0
        self._handlers: dict[type, Callable[[Any], None]] = {
            Listening: listening,
            t.Try: self._want,
            t.Pin: self._pin,
            t.LookAt: self._look_at,
            t.ChooseFrames: self._choose_frames,
            t.SaveTries: self._save,
            t.StartSearch: self._start_search,
            t.StopSearch: lambda request: self._stop_search(),
            Quit: lambda request: self._quit(),
        }
        self._begin(choice, search)

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Work until told to stop: by ``should_stop``, by the viewer, or because the link is lost."""
        self.work_until_over(should_stop, self._carry_out_requests, self._work)

    def idle(self) -> float:
        """Show that there is nothing to do; returns for how many seconds to wait at most."""
        self.send(t.Activity("waiting: all scores are up to date", 1.0, busy=False))
        return super().idle()

    def show_activity(self, activity: str, share: float) -> None:
        """Show the present activity on the page, and the share of it that is done, 0 to 1."""
        self.send(t.Activity(activity, share, busy=True))

    def _work(self) -> bool:
        """Do the next piece of work; returns whether there was any."""
        if self._wanted is not None:
            self.guarded(self._try_wanted)
        elif self._searching:
            self.guarded(self._search_once)
        elif self.search is not None and self.search.best is not None and not self._is_judged:
            self.guarded(self._judge_found)
        else:
            return False
        return True

    def _begin(self, choice: FrameChoice, search: Search | None) -> None:
        """Start on a working set, with an empty table. If it raises, the old one stays."""
        self.frames: WorkingSet = read_working_set(self._dataset, choice, keep_unseen=search is not None)
        self.search, self._is_judged, self._view = search, search is None, 0
        self.verdict: list[str] = []
        self.history = History(self.frames.source)
        self._pictures = HeldOutPictures(self.frames.held_out)
        self._publisher = MapPublisher(self.frames.source, self.link)
        self._current: int | None = None
        self._coarse = coarse_stride(self.frames.camera)
        self._newer += 1
        self._wanted: tuple[Config, By] | None = (self._config, "start")
        backend = runtime.choice()
        self.send(
            t.Tuning(
                source=self.frames.source,
                backend=backend.name if backend else "",
                device=backend.device if backend else "",
                config=self._config,
                choice=self.frames.choice,
                frames=len(self._dataset),
                training=tuple(frame.name for frame in self.frames.training),
                held_out=tuple(frame.name for frame in self.frames.held_out),
                unseen=tuple(frame.name for frame in self.frames.unseen),
            )
        )
        for problem in (*self._dataset.notes, *self.frames.skipped):
            self.send(Notice(problem, "warning"))

    def _carry_out_requests(self) -> None:
        """Carry out what the page has asked for; signals are looked at between any two requests."""
        self.read_requests()
        while len(self.waiting) and not self.is_over:
            request = self.waiting.take()
            self.guarded(partial(self._handlers[type(request)], request))

    def _want(self, request: t.Try) -> None:
        self._wanted = request.config, "hand"
        self._newer += 1

    def _go_on(self) -> Callable[[str, float], bool]:
        """The function that tells a try which begins now whether to go on."""
        began_with = self._newer

        def go_on(activity: str, share: float) -> bool:
            if self.search is not None and self._searching:
                activity = f"{self._search_text()}: {activity}"
                share = (self.search.told + share) / self.search.tries
            self.show_activity(activity, share)
            self._carry_out_requests()
            return self._newer == began_with and not self.is_over

        return go_on

    def _try_wanted(self) -> None:
        """Both passes with the latest requested parameters."""
        assert self._wanted is not None
        (config, by), self._wanted = self._wanted, None
        for pixel_stride in dict.fromkeys((self._coarse, 1)):
            trial = run_trial(config, self.frames, pixel_stride=pixel_stride, go_on=self._go_on())
            if trial is None:
                return
            attempt = self._note(trial, by)
            if pixel_stride == 1:
                self._config = config
                self._show(trial, attempt)

    def _search_once(self) -> None:
        """One step of the search. If a person's request interrupts it, it is repeated afterwards."""
        assert self.search is not None
        config, stride = self.search.ask(), self.search.pixel_stride or self._coarse
        try:
            trial = run_trial(config, self.frames, pixel_stride=stride, go_on=self._go_on())
        except TaichiMRFError:
            self.search.tell(float("nan"))
            raise
        if trial is None:
            return
        self.search.tell(self.search.objective.value(trial.scores))
        attempt = self._note(trial, "search")
        if self.search.best == config:
            self._show(trial, attempt)
        if self.search.done:
            self._show_found()

    def _show_found(self) -> None:
        """Map with the parameters that the search has found, with all pixels."""
        assert self.search is not None
        if self.search.best is not None:
            self._wanted = self.search.best, "search"

    @property
    def _searching(self) -> bool:
        return self.search is not None and not self.search.done

    def _start_search(self, request: t.StartSearch) -> None:
        if self._searching:
            raise ConfigError("a search is running: stop it first")
        search = Search(self._config, (), request.tries, seed=0, objective=request.objective)
        self._begin(self.frames.choice, search)

    def _stop_search(self) -> None:
        if self.search is not None and self._searching:
            self.search.tries = self.search.told
            self._newer += 1
            self._show_found()

    def _judge_found(self) -> None:
        """Once, after the search: score its result on the unseen views."""
        assert self.search is not None
        assert self.search.best is not None
        compared = contenders(self.search.start, self.search.best)
        verdict = judge_unseen(self.frames, compared, self._go_on())
        if verdict is None:
            return
        self._is_judged, self.verdict = True, verdict_lines(verdict)
        self._judged(self.verdict)
        self.send(verdict)
        kind, (before, *_, after) = self.search.objective, verdict.scores.values()
        gain = f"{kind.label} {kind.text(after)}, with shipped defaults {kind.text(before)}"
        on = f"on {verdict.views} views that were never looked at before"
        self.send(Notice(f"The search has ended; {on}: {gain}. More is in the tab Search."))
        if self.policy.out is not None:
            write_text(self.policy.out / BEST_FILE, self.best_yaml() or "")

    def best_yaml(self) -> str | None:
        """Text of the file with what the search has found and its verdict; None if it has found nothing."""
        best = None if self.search is None else self.search.best
        attempt = next((each for each in self.history.attempts if each.config == best), None)
        return None if attempt is None else self.history.to_yaml(attempt.number, tuple(self.verdict))

    def _search_text(self) -> str:
        assert self.search is not None
        return f"search, {self.search.told + 1} of {self.search.tries}"

    def _note(self, trial: Trial, by: By) -> Attempt:
        """Add a try to the table, and send it to the page."""
        attempt = self.history.note(trial.config, trial.scores, by)
        self._pictures.keep(attempt.number, trial.views, trial.scores.pixel_stride, self.history.pinned)
        self.send(attempt.message())
        if attempt.number == self.history.pinned:
            self.send(t.Pinned(self.history.pinned))
        if by != "search" and trial.scores.pixel_stride == self._coarse:  # once is enough
            for text in trial.warnings:
                self.send(Notice(text, "warning"))
        self._tried(attempt)
        return attempt

    def _show(self, trial: Trial, attempt: Attempt) -> None:
        """Show map, plot and pictures of a try."""
        self._current = attempt.number
        self.send(t.Chosen(attempt.number, attempt.config))
        self._publisher.show(trial)
        self.send(residuals_of(attempt.number, trial.views))
        self._send_pictures()

    def _send_pictures(self) -> None:
        if self._current is not None:
            shown = self._pictures.show(self._view, self._current, self.history)
            if shown is not None:
                self.send(shown)

    def _pin(self, request: t.Pin) -> None:
        self.history.pin(request.number)
        self.send(t.Pinned(self.history.pinned))
        self._send_pictures()

    def _look_at(self, request: t.LookAt) -> None:
        if not 0 <= request.view < len(self.frames.held_out):
            raise ConfigError(f"there is no held-out view {request.view}")
        self._view = request.view
        self._send_pictures()

    def _choose_frames(self, request: t.ChooseFrames) -> None:
        if self._searching:
            raise ConfigError("the frames stay those of the search: stop it first")
        self._begin(request.choice, None)

    def _save(self, request: t.SaveTries) -> None:
        """Send a file to the browser that asked for it; with --out it is also left there."""
        if request.kind == "best":
            name, text = BEST_FILE, self.best_yaml()
        else:
            name, text = self.history.file(request.kind, request.number)
        if text is None:
            raise ConfigError("the search has found nothing yet")
        if self.policy.out is not None:
            write_text(self.policy.out / name, text)
        self.send(File(name, text.encode(), request.client))
        if self.policy.out is not None:
            self.send(Notice(f"{name} is in {self.policy.out}"))

    def _quit(self) -> None:
        self.ended = True


class MapPublisher:
    """Sends one map after the other; each replaces the one before."""

    def __init__(self, source: str, link: Link) -> None:
        self._source, self._link = source, link
        self._shown: Mapper | None = None
        self._hello: Hello | None = None
        self._names: list[str] = []

    def show(self, trial: Trial) -> None:
        """Send a map with its keyframes. If grid, prior and keyframes are those of the map before, only
        bricks are sent, so that the picture does not go black in between."""
        before, self._shown = self._shown, Mapper(trial.map)
        hello, publisher = self._shown.hello(self._source), self._shown.shown.publisher
        bricks = publisher.changes() or publisher.everything_gone()
        keyframes = [self._shown.describe(entry) for entry in self._shown.roster.entries.values()]
        names = [keyframe.name for keyframe in keyframes]
        if before is not None and (self._hello, self._names) == (hello, names):
            gone = [before.shown.publisher.everything_gone()]
        else:
            gone = []
            self._link.send(hello)
        for keyframe in keyframes:
            self._link.send(keyframe)
        self._link.send(merged([*gone, bricks]))
        self._hello, self._names = hello, names
