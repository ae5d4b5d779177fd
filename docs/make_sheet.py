"""Makes a sheet of screenshots of both pages, to be looked at: each tab in three windows, light and dark.

    python docs/make_sheet.py [FOLDER]     # sheet.jpg and each screenshot; a new temporary folder by default

Needs the same as make_pictures.py.
"""

import math
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from make_pictures import LivePage, LiveProgram, chromium, page_pictures
from PIL import Image

ROOM = "synthetic:room?frames=29"
WINDOWS = {"laptop": (1280, 800), "desktop": (1920, 1080), "phone": (390, 844)}
LIVE_TABS = ("Map", "Keyframes", "Ray", "Images", "Save", "About")
TUNE_TABS = ("Parameters", "Search", "Views", "Tries", "Noise", "Map", "Frames")
ROW_PX = 400
"""Height of a screenshot on the sheet."""

Shots = Iterator[tuple[str, Image.Image]]


def main() -> None:
    """Take all screenshots and put them on one sheet, a row for each page, window and kind of colours."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    rows = [row for command in ("live", "tune") for row in rows_of(command, folder)]
    sheet = Image.new("RGB", (max(row.width for row in rows), ROW_PX * len(rows)), "white")
    for i, row in enumerate(rows):
        sheet.paste(row, (0, ROW_PX * i))
    sheet.save(folder / "sheet.jpg", quality=85)
    print(f"wrote {folder / 'sheet.jpg'}")


def rows_of(command: str, folder: Path) -> Iterator[Image.Image]:
    """The rows of one page, whose screenshots are kept in a folder. Voxels are large: a browser that draws by
    software takes seconds for a picture of small ones."""
    with LiveProgram(ROOM, "--voxel-size", "0.08", command=command) as program, chromium() as browser:
        for window, size in WINDOWS.items():
            with LivePage(browser, program.address, *size) as page:
                page.until(lambda seen: seen.settled and (seen.voxels or seen.triangles), "a settled map")
                if window == "phone":
                    page.page.mouse.click(size[0] / 2, size[1] - 20)  # on the panel's head, which unfolds it
                elif command == "tune" and "Try 2" not in page.text():
                    make_tries(page)
                for scheme in ("light", "dark"):
                    page.page.emulate_media(color_scheme=scheme)
                    row = []
                    for name, picture in live_shots(page) if command == "live" else tune_shots(page):
                        picture.save(folder / f"{command}_{window}_{scheme}_{name}.png")
                        row.append(picture.resize((ROW_PX * size[0] // size[1], ROW_PX)))
                    print(f"{command}, {window}, {scheme}: {len(row)} screenshots", flush=True)
                    yield page_pictures.side_by_side(*row)


def make_tries(page: LivePage) -> None:
    """Make two tries, and compare the second one with the first."""
    for number, density in ((1, 5.0), (2, 1.0)):
        page.slide("Surface density (per m)", density)
        page.until(lambda seen, n=number: seen.settled and f"Try {n}" in page.text(), f"try {number} at rest")
    page.tab("Tries")
    page.select("Selected try", re.compile("^1: "))
    page.press("Pin")
    page.until(lambda seen: "against try 1" in page.text(), "the reference")


def tune_shots(page: LivePage) -> Shots:
    """Screenshots of each tab of the tuning page, and of all scores."""
    for tab in TUNE_TABS:
        page.tab(tab)
        yield tab, page_pictures.shot(page)
    page.page.get_by_text("More scores").click()
    yield "more_scores", page_pictures.shot(page)
    page.page.get_by_text("More scores").click()


def live_shots(page: LivePage) -> Shots:
    """Screenshots of each tab of the live page, of images, a time, a cut, and the answer to a click."""
    for tab in LIVE_TABS:
        page.tab(tab)
        yield tab, page_pictures.shot(page)
    page.tab("Images")
    page.tick("Show images")
    page.page.locator("img:visible").nth(2).wait_for()
    yield "shown_images", page_pictures.shot(page)
    page.tick("Show images", on=False)
    page.tab("Map")
    if not page.input("Time (s)").is_visible():  # folded at first on a phone
        page.page.get_by_text("Time", exact=True).click()
    page.slide("Time (s)", 2.5)
    page.until(lambda seen: seen.agrees and "keyframe" in page.text(), "the map of that time")
    yield "time", page_pictures.shot(page)
    page.slide("Time (s)", 1e3)
    page.until_settled()
    page.tick("Free space")
    page.show("voxels", "uncertainty")
    page.until(lambda seen: seen.settled and seen.voxels, "voxels")
    yield "cut", page_pictures.shot(page)
    page.tick("Free space", on=False)
    page.show("surface", "height")
    page.until(lambda seen: seen.settled and seen.triangles, "the surface")
    size = page.page.viewport_size
    assert size is not None
    target = 0.3 * size["width"], 0.45 * size["height"]  # amid the surface: a click on its rim may miss it
    places = page.free_places(page.places("/surface", "vertices"))
    page.click(*min(places, key=lambda place: math.dist(place[:2], target))[:2])
    page.page.get_by_role("button", name="Close").wait_for()
    yield "answer", page_pictures.shot(page)
    page.press("Close")


if __name__ == "__main__":
    main()
