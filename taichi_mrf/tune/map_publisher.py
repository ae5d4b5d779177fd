"""Sends the map of the selected try to the page, as changes to the map before."""

from taichi_mrf.session.link import Link
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.outbox import merged
from taichi_mrf.system import runtime
from taichi_mrf.tune.trial import Trial
from taichi_mrf.viewer.messages import Hello


class MapPublisher:
    """Sends one map after the other; each replaces the one before."""

    def __init__(self, source: str, link: Link) -> None:
        self._source, self._link = source, link
        self._shown: Mapper | None = None
        self._hello: Hello | None = None

    def show(self, trial: Trial) -> None:
        """Send a map with its keyframes. If grid, prior and keyframes are those of the map before, only
        bricks are sent, so that the picture does not go black in between."""
        before, self._shown = self._shown, Mapper(trial.map)
        hello, publisher = self._describe(trial), self._shown.shown.publisher
        bricks = publisher.changes() or publisher.everything_gone()
        keyframes = [self._shown.describe(entry) for entry in self._shown.roster.entries.values()]
        names = [keyframe.name for keyframe in keyframes]
        if before is not None and self._hello == hello and _names(before) == names:
            gone = [before.shown.publisher.everything_gone()]
        else:
            gone = []
            self._link.send(hello)
        for keyframe in keyframes:
            self._link.send(keyframe)
        self._link.send(merged([*gone, bricks]))
        self._hello = hello

    def _describe(self, trial: Trial) -> Hello:
        assert self._shown is not None
        backend = runtime.choice()
        return Hello(
            source=self._source,
            backend=backend.name if backend else "",
            device=backend.device if backend else "",
            method=trial.config.method,
            voxel_size=trial.map.voxel_size,
            prior_log_odds=trial.map.view.pool.prior_log_odds,
            min_evidence=self._shown.min_evidence,
            parameters="",
        )


def _names(mapper: Mapper) -> list[str]:
    return [entry.name for entry in mapper.roster.entries.values()]
