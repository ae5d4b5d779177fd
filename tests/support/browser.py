"""A real Chromium that looks at the live page, for tests: it does what a user does, and counts what is there.

What is in the scene is read from the three.js objects that the page draws (viser's client keeps them at
``window.__viserMutable``), not from what the server says.
"""

import importlib.util
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from live_program import DEADLINE_S, LiveProgram, wait_for

from taichi_mrf import MRFMap
from taichi_mrf.system import runtime

if TYPE_CHECKING:  # an extra that only these tests need
    from playwright.sync_api import Browser, Download, Locator
else:
    Browser = Any

ARTIFACTS = Path(__file__).resolve().parents[2] / "test-artifacts"
"""Folder of screenshots; git ignores it."""

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]

HARMLESS = (
    "Failed to load resource: the server responded with a status of 404",
    "Evaluating a string as JavaScript violates",
)
"""Beginnings of error messages that mean no harm: the icon that browsers ask for by themselves; and the
sorter of Gaussian splats in viser's page, which may not compile code, and which nothing here needs."""

LOOK = """() => {
  const mutable = window.__viserMutable;
  const inScene = node => {
    let last = node;
    for (; last; last = last.parent) {
      if (!last.visible) return false;
      if (last === mutable.scene) return true;
    }
    return false;
  };
  const seen = {voxels: 0, baseline: 0, triangles: 0, colors: 0, nodes: []};
  const hash = (start, numbers) =>
    numbers.reduce((h, number) => Math.imul(31 * h + Math.round(number) | 0, 2654435761) >>> 0, start);
  for (const [name, node] of Object.entries(mutable?.nodeRefFromName ?? {}).sort()) {
    if (!node || !inScene(node)) continue;
    seen.nodes.push(name);
    const root = name.split('/')[1];
    if (!(root in {voxels: 0, baseline: 0, surface: 0}) || name.split('/').length < 3) continue;
    node.traverse(object => {
      if (object.isMesh) seen.triangles += object.geometry.index.count / 3;
      if (!object.isPoints) return;
      const {position, color} = object.geometry.attributes;
      const cloud = hash(7, [...name].map(letter => letter.codePointAt(0)));
      seen[root] += position?.count ?? 0;
      // A sum, since the order of the points depends on how updates were merged on their way.
      for (let i = 0; i < (color?.count ?? 0); i++) {
        const cell = [position.getX(i), position.getY(i), position.getZ(i)];
        const rgb = [color.getX(i), color.getY(i), color.getZ(i)].map(share => 255 * share);
        seen.colors = (seen.colors + hash(cloud, [...cell, ...rgb])) % 2 ** 32;
      }
    });
  }
  const paragraphs = [...document.querySelectorAll('p')];
  const counts = paragraphs.find(p => /^[0-9,]+ (voxels|triangles|measured points) /.test(p.textContent));
  seen.counts = counts?.textContent ?? '';
  let panel = counts;
  while (panel && !panel.querySelector('.mantine-Progress-root')) panel = panel.parentElement;
  seen.activity = panel?.querySelector('p')?.textContent ?? '';
  seen.table = {};
  for (const row of document.querySelectorAll('tr'))
    if (row.cells.length === 2) seen.table[row.cells[0].textContent] = row.cells[1].textContent;
  return seen;
}"""

# Where the points of a node are on the page: (x, y, depth) of some, in pixels and metres from the eye.
_PROJECT = """([prefix, kind, local]) => {
  const mutable = window.__viserMutable, camera = mutable.camera;
  const box = mutable.canvas.getBoundingClientRect();
  camera.updateMatrixWorld();
  const times = (m, [x, y, z, w]) => [0, 1, 2, 3].map(i =>
    m.elements[i] * x + m.elements[i + 4] * y + m.elements[i + 8] * z + m.elements[i + 12] * w);
  const found = [];
  const put = (object, point) => {
    const view = times(camera.matrixWorldInverse, times(object.matrixWorld, [...point, 1]));
    const clip = times(camera.projectionMatrix, view);
    if (view[2] >= 0) return;
    found.push([box.x + (clip[0] / clip[3] + 1) / 2 * box.width,
                box.y + (1 - clip[1] / clip[3]) / 2 * box.height, -view[2]]);
  };
  for (const [name, node] of Object.entries(mutable.nodeRefFromName)) {
    if (!node || !name.startsWith(prefix)) continue;
    node.updateWorldMatrix(true, true);
    if (kind === 'origin') { put(node, local); continue; }
    node.traverse(object => {
      if (kind === 'points' && object.isPoints) {
        const p = object.geometry.attributes.position;
        for (let i = 0; i < p.count; i++) put(object, [p.getX(i), p.getY(i), p.getZ(i)]);
      }
      if (kind === 'vertices' && object.isMesh) {
        const p = object.geometry.attributes.position;
        for (let i = 0; i < p.count; i += 97) put(object, [p.getX(i), p.getY(i), p.getZ(i)]);
      }
      if (kind === 'picture' && object.isMesh && object.material.map) put(object, [0, 0, 0]);
    });
  }
  return found;
}"""

_POSITION = """async name => {
  const mutable = window.__viserMutable, root = mutable.nodeRefFromName[''];
  const find = () => name ? mutable.nodeRefFromName[name] : mutable.camera;
  while (!find()) await new Promise(requestAnimationFrame);  // a node that changes is away for a moment
  const node = find();
  node.updateWorldMatrix(true, false);
  const [x, y, z] = node.matrixWorld.elements.slice(12), m = root.matrixWorld.clone().invert().elements;
  return [0, 1, 2].map(i => m[i] * x + m[i + 4] * y + m[i + 8] * z + m[i + 12]);
}"""


_CUT_OFF = """() => {
  const widgets = [...document.querySelectorAll("button, input, label, p, td, [role=tab]")];
  const cutOff = element => {
    const {left, right, width} = element.getBoundingClientRect();
    const fits = element.role === "tab" || element.scrollWidth <= element.clientWidth + 1;
    return element.offsetParent && width && (left < 0 || right > innerWidth || !fits);
  };
  return widgets.filter(cutOff).map(element => element.value || element.textContent.trim());
}"""


def missing() -> str | None:
    """Part that this machine lacks to run a browser, None if all is there."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is not installed (extra: dev)"
    if _chromium() is None:
        return "there is no chromium on this machine (Debian: apt install chromium)"
    return None


@contextmanager
def chromium() -> Iterator["Browser"]:
    """A browser without a window, which draws by software."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=_chromium(), headless=True, args=FLAGS)


def _chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser")


@dataclass(frozen=True)
class Seen:
    """One look at a page: what it says of itself, and what is in its scene.

    ``said``, ``said_baseline`` and ``said_triangles`` are the counts that the page gives, ``voxels`` and
    ``baseline`` the points that it draws, ``triangles`` those of the surface;
    ``colors`` changes with the colour or place of any voxel's point, and not with their order. ``table`` is
    that of the tab About, empty while another one is in front.
    """

    said: int
    said_baseline: int
    said_triangles: int
    voxels: int
    baseline: int
    triangles: int
    colors: int
    nodes: tuple[str, ...]
    activity: str
    table: dict[str, str]

    @property
    def keyframes(self) -> list[str]:
        """The nodes of keyframes."""
        return [name for name in self.nodes if name.startswith("/keyframes/")]

    @property
    def agrees(self) -> bool:
        """True if the scene holds as many voxels and triangles as the page says."""
        said = self.said, self.said_baseline, self.said_triangles
        return said == (self.voxels, self.baseline, self.triangles)

    @property
    def settled(self) -> bool:
        """True if the map is at rest, and the scene shows all that the page says."""
        return self.agrees and "up to date" in self.activity


class LivePage:
    """A page in a browser. ``problems`` are the errors that it has reported."""

    def __init__(
        self, browser: "Browser", address: str, width: int = 1280, height: int = 800, script: str = ""
    ) -> None:
        """``script`` runs before those of the page."""
        self.page = browser.new_page(viewport={"width": width, "height": height}, accept_downloads=True)
        self.page.add_init_script(script)
        self.page.set_default_timeout(1000 * DEADLINE_S)
        self.problems: list[str] = []
        self.page.on("console", lambda message: self._note(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self._note(str(error)))
        self.page.goto(address if address.startswith("file:") else f"{address}/?fixedDpr=1")
        self.page.wait_for_function("() => window.__viserMutable?.scene != null")

    def look(self) -> Seen:
        """Things to be seen now."""
        found = self.page.evaluate(LOOK)
        words = found.pop("counts").replace(",", "").split()
        said_baseline = int(words[words.index("baseline") - 3]) if "baseline" in words else 0
        counts = {"said_baseline": said_baseline}
        for name, field in (("voxels", "said"), ("triangles", "said_triangles")):
            counts[field] = int(words[words.index(name) - 1]) if name in words else 0
        return Seen(**counts, nodes=tuple(found.pop("nodes")), **found)

    def until(self, condition: Callable[[Seen], object], what: str) -> Seen:
        """Look until a condition holds; returns what was then to be seen."""
        last: list[Seen] = []

        def met() -> bool:
            last[:] = [self.look()]
            return bool(condition(last[0]))

        wait_for(met, lambda: f"{what}; last seen: {last[0]}", self.pause)
        return last[0]

    def until_settled(self) -> Seen:
        """Wait until the map is at rest, and show its voxels."""
        self.until(lambda seen: seen.settled and (seen.voxels or seen.triangles), "a settled map")
        self.tab("Map")
        self.show("voxels", "height")
        return self.until(lambda seen: seen.settled and seen.voxels, "the voxels of a settled map")

    def pause(self, seconds: float) -> None:
        """Wait, while the page goes on."""
        self.page.wait_for_timeout(1000 * seconds)

    def cut_off(self) -> list[str]:
        """Texts of widgets that leave the window or do not fit into their place."""
        return self.page.evaluate(_CUT_OFF)

    def text(self) -> str:
        """All text of the page, without the tabs that are not in front."""
        return self.page.evaluate("() => document.body.innerText")

    def tab(self, name: str) -> None:
        """Bring a tab to the front."""
        self.page.get_by_role("tab", name=name).click()

    def press(self, name: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def input(self, label: str) -> "Locator":
        """The element of the widget with this label, looked for anew each time it is used."""
        text = "normalize-space(translate(., '\N{EM SPACE}', ' '))"  # some are indented
        return self.page.locator(f'xpath=//*[@id = //label[{text} = "{label}"]/@for]')

    def fill(self, label: str, *numbers: float) -> None:
        """Type numbers into the boxes of a vector, from the first one on."""
        boxes = self.input(label).locator("xpath=../../..").get_by_role("textbox")
        for i, number in enumerate(numbers):
            boxes.nth(i).fill(f"{number:g}")

    def slide(self, label: str, value: float) -> None:
        """Type a value into the box of a slider."""
        self.input(label).locator("xpath=..").get_by_role("textbox").fill(f"{value:g}")

    def nudge(self, label: str, key: str) -> None:
        """Press a key on a slider's thumb."""
        self.input(label).get_by_role("slider").press(key)

    def select(self, label: str, option: str | re.Pattern[str]) -> None:
        """Choose from a dropdown: the option with this text, or the one that a pattern is found in."""
        self.input(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def show(self, drawn_as: str, color_by: str) -> None:
        """Choose how the map is drawn and what its colours say, in the tab Map."""
        self.select("Draw as", drawn_as)
        self.select("Color by", color_by)

    def tick(self, label: str, on: bool = True) -> None:
        """Set or clear a checkbox."""
        self.input(label).set_checked(on)

    def download(self, button: str) -> "Download":
        """Press a button and take the file that comes."""
        with self.page.expect_download() as waiting:
            self.press(button)
        return waiting.value

    def saved_map(self, folder: Path) -> MRFMap:
        """The map as the page's button saves it now; the tab Save is left open."""
        path = folder / "saved.npz"
        self.tab("Save")
        self.download("Map (.npz)").save_as(path)
        runtime.init("cpu")
        return MRFMap.load(path)

    def places(
        self, prefix: str, kind: str, local: tuple[float, float, float] = (0, 0, 0)
    ) -> list[list[float]]:
        """Places of nodes on the page, each as x, y in pixels and metres from the eye: the ``points`` of
        clouds, some ``vertices`` of meshes, the middle of a frustum's ``picture``, or a point of the node
        itself (``origin``)."""
        return self.page.evaluate(_PROJECT, [prefix, kind, local])

    def free_places(self, places: list[list[float]]) -> list[list[float]]:
        """Those of some places that nothing of the page's panel lies before."""
        test = "([x, y]) => document.elementFromPoint(x, y) === window.__viserMutable.canvas"
        return [place for place in places if self.page.evaluate(test, place[:2])]

    def click(self, x: float, y: float) -> None:
        """Click as a hand does, which stands still for a moment before."""
        self.page.mouse.move(x, y)
        self.pause(0.2)
        self.page.mouse.click(x, y, delay=50)

    def position(self, node: str = "") -> tuple[float, float, float]:
        """Place of a node in the map's world, in metres; without a name, the eye that looks at the scene."""
        return tuple(self.page.evaluate(_POSITION, node))

    def screenshot(self, name: str) -> Path:
        """Keep what the page looks like."""
        path = ARTIFACTS / f"{name}.png"
        self.page.screenshot(path=path)
        return path

    def close(self) -> None:
        """Leave."""
        self.page.close()

    def _note(self, problem: str) -> None:
        if not problem.startswith(HARMLESS):
            self.problems.append(problem)

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(self, *exception: Any) -> None:
        self.close()


@contextmanager
def live_page(browser: "Browser", *arguments: str | Path, **options: Any) -> Iterator[LivePage]:
    """The page of ``taichi-mrf live``, run with these arguments."""
    with LiveProgram(*arguments) as program, LivePage(browser, program.address, **options) as page:
        yield page
