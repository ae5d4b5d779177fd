"""Makes docs/images/live.gif and live.png: the built-in room on the live page, in a browser.

    python docs/make_clip.py

Needs what the browser tests need: playwright (extra: dev) and Debian's chromium. The browser draws by
software and is slow, so the pictures are taken one by one and played at a fixed rate.
"""

import io
import re
import sys
from pathlib import Path

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "tests" / "support"))  # the driver of the browser tests serves here too

from browser import LivePage, chromium  # noqa: E402
from live_program import LiveProgram  # noqa: E402
from page_pictures import level_cut  # noqa: E402

from taichi_mrf.viewer.scene.coloring import DYNAMIC_COLOR  # noqa: E402

IMAGES = REPOSITORY / "docs" / "images"
ROOM = ("synthetic:room", "--voxel-size", "0.05", "--speed", "0.2")
"""At this speed a frame arrives each second, which is enough for the browser to draw it."""

WIDTH, HEIGHT = 1240, 700
CLIP_WIDTH = 640
COLORS = 80
CAMERA_COLOR = (230, 0, 126)
"""The colour of the camera and its path. Like dynamic voxels they have too few pixels to enter the palette by
themselves."""

FRAME_MS, LAST_MS = 150, 1500

ORBIT_SHOTS, ORBIT_PIXELS = 16, 19.0
CUT_SHOTS, CUT_FROM, CUT_TO = 16, 0.85, 0.35


def main() -> None:
    """Run the room once and write both files."""
    with LiveProgram(*ROOM) as program, chromium() as browser:
        with LivePage(browser, program.address, WIDTH, HEIGHT) as page:
            shots = keyframes_arriving(page) + orbit(page) + cut_moving_through(page)
        write_clip(shots, IMAGES / "live.gif")
        with LivePage(browser, program.address, 1280, 800) as page:
            small_colors(still(page), 255).save(IMAGES / "live.png", optimize=True)
    for name in ("live.gif", "live.png"):
        print(f"wrote {IMAGES / name}: {(IMAGES / name).stat().st_size / 1e6:.1f} MB, {len(shots)} pictures")


def shot(page: LivePage) -> Image.Image:
    """A screenshot after the page has drawn everything."""
    page.pause(0.4)
    return Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")


def keyframes_arriving(page: LivePage) -> list[Image.Image]:
    """One picture for each keyframe, from the first one."""
    close_warning(page)
    page.press("Reset")
    page.press("Delete the map and start again")
    page.until(lambda seen: len(seen.keyframes) < 2, "a new beginning")
    shots: list[Image.Image] = []
    counts = [0]
    while True:
        seen = page.until(lambda seen: seen.settled or len(seen.keyframes) > counts[-1], "a keyframe")
        shots.append(shot(page))
        counts.append(len(seen.keyframes))
        if seen.settled:
            return shots


def orbit(page: LivePage) -> list[Image.Image]:
    """A turn around the map, by dragging the mouse beside it."""
    shots, mouse, (x, y) = [], page.page.mouse, (0.3 * WIDTH, 0.1 * HEIGHT)
    mouse.move(x, y)
    mouse.down()
    for i in range(1, ORBIT_SHOTS + 1):
        mouse.move(x + i * ORBIT_PIXELS, y)
        shots.append(shot(page))
    mouse.up()
    return shots


def cut_moving_through(page: LivePage) -> list[Image.Image]:
    """A level cut that moves down through the room and shows free space."""
    shots = []
    level_cut(page, CUT_FROM)
    page.page.mouse.move(0.3 * WIDTH, 0.1 * HEIGHT)
    for share in np.linspace(CUT_FROM, CUT_TO, CUT_SHOTS):
        level_cut(page, float(share))
        page.until(lambda seen: seen.agrees, "the cut")
        shots.append(shot(page))
    page.select("Cut axis", "none")
    page.until_settled()
    return shots


def still(page: LivePage) -> Image.Image:
    """The whole map, with the ray of one pixel of a keyframe."""
    page.until_settled()
    close_warning(page)
    page.tab("Keyframes")
    page.select("Keyframe", re.compile("room-0009"))
    page.tab("Ray")
    page.fill("Pixel (u, v)", 160, 130)
    page.press("Show the ray")
    page.until(lambda seen: "/ray" in seen.nodes, "the ray")
    page.pause(1.0)
    return shot(page)


def close_warning(page: LivePage) -> None:
    """Close the notice about browsers that draw by software."""
    page.page.locator(".mantine-Notification-closeButton").first.click()
    page.pause(0.5)


def small_colors(picture: Image.Image, count: int) -> Image.Image:
    """The picture in few colours, for a small file."""
    return picture.quantize(count, dither=Image.Dither.NONE)


def side_by_side(pictures: list[Image.Image]) -> Image.Image:
    """Pictures of the same size in a row, as one picture."""
    return Image.fromarray(np.concatenate([np.asarray(each) for each in pictures], axis=1))


def write_clip(shots: list[Image.Image], path: Path, frame_ms: int = FRAME_MS) -> None:
    """Write a GIF of all pictures with one palette, each shown for some milliseconds."""
    size = CLIP_WIDTH, round(CLIP_WIDTH * HEIGHT / WIDTH)
    small = [each.resize(size, Image.Resampling.LANCZOS) for each in shots]
    rare = [Image.new("RGB", (size[0] // 4, size[1]), color) for color in (CAMERA_COLOR, DYNAMIC_COLOR)]
    palette = small_colors(side_by_side([*small[:: len(small) // 8], *rare]), COLORS)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in small]
    durations = [frame_ms] * (len(frames) - 1) + [LAST_MS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True)


if __name__ == "__main__":
    main()
