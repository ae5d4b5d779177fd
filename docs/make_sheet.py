"""Makes a sheet of screenshots of the live page, to be looked at: each tab in three windows, light and dark.

    python docs/make_sheet.py [FOLDER]     # sheet.jpg and each screenshot; a new temporary folder by default

Needs the same as make_pictures.py.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from make_pictures import LivePage, LiveProgram, chromium, page_pictures
from PIL import Image

ROOM = "synthetic:room?frames=29"
WINDOWS = {"laptop": (1280, 800), "desktop": (1920, 1080), "phone": (390, 844)}
TABS = ("Map", "Keyframes", "Ray", "Images", "Save", "About")
ROW_PX = 400
"""Height of a screenshot on the sheet."""


def main() -> None:
    """Take all screenshots and put them on one sheet, a row for each window and kind of colours."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    rows = []
    with LiveProgram(ROOM, "--voxel-size", "0.05") as program, chromium() as browser:
        for window, size in WINDOWS.items():
            with LivePage(browser, program.address, *size) as page:
                page.until(lambda seen: seen.settled and (seen.voxels or seen.triangles), "a settled map")
                if window == "phone":
                    page.page.mouse.click(size[0] / 2, size[1] - 20)  # on the panel's head, which unfolds it
                for scheme in ("light", "dark"):
                    page.page.emulate_media(color_scheme=scheme)
                    row = []
                    for name, picture in shots(page):
                        picture.save(folder / f"{window}_{scheme}_{name}.png")
                        row.append(picture.resize((ROW_PX * size[0] // size[1], ROW_PX)))
                    rows.append(page_pictures.side_by_side(*row))
    sheet = Image.new("RGB", (max(row.width for row in rows), ROW_PX * len(rows)), "white")
    for i, row in enumerate(rows):
        sheet.paste(row, (0, ROW_PX * i))
    sheet.save(folder / "sheet.jpg", quality=85)
    print(f"wrote {folder / 'sheet.jpg'}")


def shots(page: LivePage) -> Iterator[tuple[str, Image.Image]]:
    """Screenshots of each tab, of images, of a time, of a cut, and of the answer to a click."""
    for tab in TABS:
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
    places = page.free_places(page.places("/surface", "vertices"))
    page.click(*min(places, key=lambda place: place[2])[:2])  # the nearest that is to be seen
    page.page.get_by_role("button", name="Close").wait_for()
    yield "answer", page_pictures.shot(page)
    page.press("Close")


if __name__ == "__main__":
    main()
