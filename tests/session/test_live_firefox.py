"""The live page in Firefox: its first view, and the points of a drawing that is chosen there."""

import base64
import json
import os
import re
import shutil
import subprocess
import threading
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import pytest
from browser import ARTIFACTS, LOOK
from live_program import LiveProgram, wait_for
from numpy.typing import NDArray
from websockets.sync.client import ClientConnection, connect

SIZE = (1280, 800)

PREFERENCES = {"webgl.force-enabled": True, "gfx.webrender.software": True, "app.normandy.enabled": False}

HARMLESS = ("blocked a JavaScript eval", "call to Function() blocked by CSP")
"""Parts of messages that mean no harm: the sorter of splats, as in browser.HARMLESS."""

_MIDDLE_OF = """(() => {{
  const box = document.evaluate({path}, document, null, 9).singleNodeValue?.getBoundingClientRect();
  return JSON.stringify(box?.width ? [box.x + box.width / 2, box.y + box.height / 2] : null);
}})()"""


def missing() -> str | None:
    """Part that this machine lacks to run Firefox, None if all is there."""
    for program, package in (("firefox-esr", "firefox-esr"), ("Xvfb", "xvfb")):
        if shutil.which(program) is None:
            return f"there is no {program} on this machine (Debian: apt install {package})"
    return None


class Firefox:
    """A window of Firefox at an address; use it as a context. ``folder`` is for its profile. ``problems`` are
    the errors that the page has reported."""

    def __init__(self, address: str, folder: Path) -> None:
        lines = [
            f"user_pref({json.dumps(name)}, {json.dumps(value)});" for name, value in PREFERENCES.items()
        ]
        (folder / "user.js").write_text("\n".join(lines))
        self.problems: list[str] = []
        self._calls = 0
        self._open = ExitStack()
        try:
            self._session = self._begin(folder)
            self._call("session.new", capabilities={})
            self._call("session.subscribe", events=["log.entryAdded"])
            self._page = self._call("browsingContext.getTree")["contexts"][0]["context"]
            size = dict(zip(("width", "height"), SIZE, strict=True))
            self._call("browsingContext.setViewport", context=self._page, viewport=size)
            self._call("browsingContext.navigate", context=self._page, url=address, wait="complete")
        except BaseException:
            self._open.close()
            raise

    def __enter__(self) -> "Firefox":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def look(self) -> dict[str, Any]:
        """The page's words and what is in its scene, as browser.Seen has them."""
        return self._evaluate(f"JSON.stringify(window.__viserMutable?.scene ? ({LOOK})() : null)") or {}

    def select(self, label: str, option: str) -> None:
        """Choose from a dropdown."""
        text = "normalize-space(translate(., '\N{EM SPACE}', ' '))"  # some are indented
        self._click(f'//*[@id = //label[{text} = "{label}"]/@for]')
        self._click(f'//*[@role = "option"][normalize-space(.) = "{option}"]')

    def screenshot(self, name: str) -> Path:
        """Keep what the page looks like."""
        path = ARTIFACTS / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        picture = self._call("browsingContext.captureScreenshot", context=self._page)["data"]
        path.write_bytes(base64.b64decode(picture))
        return path

    def _begin(self, folder: Path) -> ClientConnection:
        """Start the screen and the browser, and connect to it."""
        number, chosen = os.pipe()
        screen = ["Xvfb", "-displayfd", str(chosen), "-screen", "0", f"{SIZE[0]}x{SIZE[1] + 100}x24"]
        self._start(screen, pass_fds=[chosen], stderr=subprocess.DEVNULL)
        os.close(chosen)
        with os.fdopen(number) as numbers:
            display = numbers.readline().strip()
        program = ["firefox-esr", "--no-remote", "--profile", str(folder), "--remote-debugging-port", "0"]
        around = os.environ | {"DISPLAY": f":{display}", "HOME": str(folder), "LIBGL_ALWAYS_SOFTWARE": "1"}
        browser = self._start(program, env=around, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        said: list[str] = []
        threading.Thread(target=lambda: said.extend(browser.stderr or ()), daemon=True).start()

        def address() -> str:
            return next(iter(re.findall(r"ws://\S+", "".join(said))), "")

        found = wait_for(address, lambda: f"Firefox; it said {said}")
        return self._open.enter_context(connect(f"{found}/session", max_size=None))

    def _start(self, command: list[str], **options: Any) -> subprocess.Popen[str]:
        """Start a program that ends with the window."""
        process = subprocess.Popen(command, text=True, **options)
        self._open.callback(process.wait)
        self._open.callback(process.terminate)
        return process

    def _call(self, method: str, **parameters: object) -> Any:
        """Send one command and return its result; what the page logs meanwhile is noted."""
        self._calls += 1
        self._session.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._session.recv())
            if answer.get("method") == "log.entryAdded":
                entry = answer["params"]
                if entry["level"] == "error" and not any(said in entry["text"] for said in HARMLESS):
                    self.problems.append(entry["text"])
            elif answer.get("id") == self._calls:
                assert answer["type"] == "success", answer
                return answer["result"]

    def _evaluate(self, expression: str) -> Any:
        """The value of an expression whose result is JSON."""
        parts = {"target": {"context": self._page}, "awaitPromise": False}
        found = self._call("script.evaluate", expression=expression, **parts)
        return json.loads(found["result"]["value"])

    def _click(self, path: str) -> None:
        """Click on the middle of the element at an XPath, as soon as it is there."""
        places: list[list[float]] = []

        def there() -> bool:
            place = self._evaluate(_MIDDLE_OF.format(path=json.dumps(path)))
            places[:] = [place] if place else []
            return bool(places)

        wait_for(there, f"an element at {path}")
        x, y = map(round, places[0])
        steps: list[dict[str, object]] = [{"type": "pointerMove", "x": x, "y": y}]
        steps += [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        pointer = {"type": "pointer", "id": "mouse", "actions": steps}
        self._call("input.performActions", context=self._page, actions=[pointer])


pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))

ROOM = "synthetic:room?frames=6&width=96&height=72"


def in_color(firefox: Firefox, name: str) -> NDArray[np.uint8]:
    """A picture of the page once the map is in it: the ground is grey and the map is not."""
    pictures: list[NDArray[np.uint8]] = []

    def colored() -> bool:
        pictures[:] = [cv2.imread(str(firefox.screenshot(name)))]
        scene = pictures[0][:, : pictures[0].shape[1] * 2 // 3].astype(int)
        return bool((scene.max(axis=2) - scene.min(axis=2) > 60).mean() > 0.05)

    wait_for(colored, f"colours in {name}.png")
    return pictures[0]


def test_firefox_shows_the_first_view_and_points(tmp_path: Path) -> None:
    profile = tmp_path / "profile"
    profile.mkdir()
    flags = ("--voxel-size", "0.08", "--runtime.arch", "cpu", "--out", tmp_path / "out")
    with LiveProgram(ROOM, *flags) as program, Firefox(program.address, profile) as firefox:

        def until(kind: str) -> None:
            """Wait for a map at rest, of whose kind the scene has as many as the page says."""

            def met() -> bool:
                seen = firefox.look()
                said = str(seen.get("counts", "")).startswith(f"{seen.get(kind, 0):,} {kind} ")
                return said and seen[kind] > 1000 and "up to date" in seen["activity"]

            wait_for(met, lambda: f"{kind} in Firefox; last seen: {firefox.look()}")

        until("triangles")
        first = in_color(firefox, "firefox_first_view")
        firefox.select("Draw as", "voxels")
        firefox.select("Color by", "marginal probability")
        until("voxels")
        voxels = in_color(firefox, "firefox_voxels")
        assert firefox.problems == []
    assert (cv2.absdiff(first, voxels).max(axis=2) > 60).mean() > 0.05
