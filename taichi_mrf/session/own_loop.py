"""A page in the browser for a map that the caller's own program makes: ``live`` beside a loop, ``show`` for a
map that is made.

The program stays in command. What it does to the map is shown when it calls :meth:`LivePage.update`, which
also carries out what the page's users have asked for: Taichi may be used by one thread only.
"""

import asyncio
import sys
import warnings
import webbrowser
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.config.arguments import ArgumentTypeError, shown
from taichi_mrf.errors import ViewerError
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.session.link import Link, ViewerLink
from taichi_mrf.session.session import Session
from taichi_mrf.session.session_core import Policy
from taichi_mrf.session.source import Source
from taichi_mrf.system.interrupts import interrupts_noted
from taichi_mrf.viewer.messages import Listening

PORT = 8080

IN_NOTEBOOK_S = 0.2
"""Time between two updates while a notebook waits for its next cell."""

_UP_TO_DATE = "the map as of the last update"


class LivePage:
    """A page that shows a map while it is made; use it as a context, or :meth:`close` it.

    ``url`` is its address. A notebook shows the page below the cell that ends with it.
    """

    def __init__(
        self,
        m: OccupancyMap,
        *,
        port: int = PORT,
        host: str = "127.0.0.1",
        browser: bool = False,
        link: Link | None = None,
    ) -> None:
        """Serve the page of a map ``m``. If ``port`` is busy, another one is taken; 0 takes any. ``browser``
        opens the page, and warns with its address if there is no browser. Raises ArgumentTypeError if
        keyframes cannot be added to ``m``, and ViewerError if the page cannot be served."""
        if not hasattr(m, "add_keyframe"):
            raise ArgumentTypeError(f"m must be a map that takes keyframes, such as MRFMap, not {shown(m)}")
        self.url, self._revision = "", -1
        self._updates: asyncio.Task[None] | None = None
        source = Source(type(m).__name__, m.config, lambda: m, own=True)
        with ExitStack() as stack:
            line = link or stack.enter_context(ViewerLink(host, port))
            self._session = Session(source, line, Policy(), self._listening)
            while link is None and not self.url:
                self._session.answer()
                if line.lost is not None:
                    raise ViewerError(line.lost)
                line.wait(0.1)
            self._open = stack.pop_all()
        if browser and not webbrowser.open(self.url):
            warnings.warn(f"no browser can be opened here; the map is at {self.url}", stacklevel=2)

    def update(self) -> bool:
        """Show the map's changes since the last call, and carry out the requests of the page's users; returns
        False once the page has ended. Call it after each keyframe, or every few. If nothing has changed, it
        updates the occupied voxels and the measured surface.
        """
        run = self._session.state
        run.look_at_keyframes()
        self._session.answer()
        if not run.is_over:
            run.publish()
            revision = run.mapper.map.view.pool.revision
            if revision == self._revision:
                self._session.rest()
            self._revision = revision
            run.show_activity(_UP_TO_DATE, 1.0)
        return not run.is_over

    @property
    def selected(self) -> NDArray[np.float64]:
        """Centres (n, 3) in metres, world, of the voxels that a user has clicked on or framed last, as of the
        last :meth:`update`; none once the answer is closed. ``m.occupancy(page.selected)`` reads them."""
        return self._session.state.selected_m

    def serve(self) -> None:
        """Answer the page until it ends or Ctrl-C is pressed. Edits are inferred at once, and the page shows
        what is occupied."""
        with interrupts_noted() as stopped:
            self.update()
            self._session.run(stopped)

    def close(self) -> None:
        """End the page; the map stays."""
        self._open.close()

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()

    def _repr_html_(self) -> str:
        """The page inside a notebook, which keeps it up to date while it waits for its next cell."""
        if self._updates is None:  # it is kept, because an event loop holds its tasks only weakly
            self._updates = asyncio.get_running_loop().create_task(self._keep_up_to_date())
        return f'<iframe src="{self.url}" width="100%" height="600" style="border: 0"></iframe>'

    async def _keep_up_to_date(self) -> None:
        while self.update():
            await asyncio.sleep(IN_NOTEBOOK_S)

    def _listening(self, where: Listening) -> None:
        self.url = where.url


def live(m: OccupancyMap, **options: Any) -> LivePage:
    """Show a map in the browser while the caller's own loop makes it.

    ``options`` are those of :class:`LivePage`. Example::

        with tm.live(m) as page:
            for depth_m, T_world_camera in camera:
                m.renew([m.add_keyframe(depth_m, T_world_camera, intrinsics)])
                page.update()
    """
    return LivePage(m, **options)


def show(m: OccupancyMap, *, browser: bool = True, **options: Any) -> LivePage:
    """Show a map in the browser: in a notebook below the cell, in a script until the page ends or Ctrl-C is
    pressed. A script opens a ``browser``, and warns of the address if it does not. The other ``options`` are
    those of :class:`LivePage`."""
    if _in_notebook():
        page = LivePage(m, **options)
        page.update()
        return page
    page = LivePage(m, browser=browser, **options)
    with page, suppress(KeyboardInterrupt):
        if not browser:
            warnings.warn(f"the map is at {page.url}", stacklevel=2)
        page.serve()
    return page


def _in_notebook() -> bool:
    """True if the program is a notebook's kernel, whose event loop runs between its cells."""
    return "ipykernel" in sys.modules
