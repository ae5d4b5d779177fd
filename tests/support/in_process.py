"""The simplest runner of tasks."""

from collections.abc import Callable, Sequence

from taichi_mrf.cluster.runner import R, T, nothing


class InProcess:
    """One task after the other in this process."""

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], done: Callable[[int, R], None] = nothing
    ) -> list[R]:
        """See TaskRunner, without its protection against dying processes."""
        results = []
        for index, task in enumerate(tasks):
            results.append(function(task))
            done(index, results[-1])
        return results
