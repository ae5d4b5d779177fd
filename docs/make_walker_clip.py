"""Makes docs/images/live_walker.gif: a person walks through the built-in room, on the live page.

    python docs/make_walker_clip.py

It needs what make_clip.py needs.
"""

from make_clip import HEIGHT, IMAGES, WIDTH, close_warning, shot, write_clip
from PIL import Image

from browser import LivePage, chromium  # isort: skip
from live_program import LiveProgram  # isort: skip

WALKER = ("synthetic:room?moving=walker", "--voxel-size", "0.05", "--speed", "0.5")
FIRST_KEYFRAMES = 12
"""The clip begins when there are so many keyframes, before the person comes in."""

FRAME_MS = 400
CLOSER = -900
"""Turns of the mouse's wheel, so that the person fills the page."""

PAST_S = (26, 24, 22, 21, 20, 19, 18, 16, 14)
"""Place of the slider at the end, in seconds."""


def main() -> None:
    """Run the room once and write the file."""
    with (
        LiveProgram(*WALKER) as program,
        chromium() as browser,
        LivePage(browser, program.address, WIDTH, HEIGHT) as page,
    ):
        shots = walking(page) + back_in_time(page)
    path = IMAGES / "live_walker.gif"
    write_clip(shots, path, FRAME_MS)
    print(f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB, {len(shots)} pictures")


def walking(page: LivePage) -> list[Image.Image]:
    """One picture for each keyframe while the person is there."""
    close_warning(page)
    page.until(lambda seen: len(seen.keyframes) >= FIRST_KEYFRAMES - 2, "most of the room")
    page.select("Color by", "plain grey")
    page.page.mouse.move(0.37 * WIDTH, 0.52 * HEIGHT)
    page.page.mouse.wheel(0, CLOSER)
    shots: list[Image.Image] = []
    count = 0
    while True:
        before = count
        seen = page.until(lambda seen: seen.settled or len(seen.keyframes) > before, "a keyframe")  # noqa: B023
        count = len(seen.keyframes)
        if count > FIRST_KEYFRAMES:
            shots.append(shot(page))
        if seen.settled:
            return shots


def back_in_time(page: LivePage) -> list[Image.Image]:
    """The slider goes back to when the room was empty, and returns to now."""
    shots = []
    for second in PAST_S:
        before = page.look()
        page.slide("Time (s)", second)
        page.until(lambda seen: seen.agrees and seen.colors != before.colors, "another time")  # noqa: B023
        shots.append(shot(page))
    return shots


if __name__ == "__main__":
    main()
