"""Makes the pictures of the documentation, docs/images/*.jpg: all of them, or the named ones.

    python docs/make_pictures.py                       # all
    python docs/make_pictures.py mesh.jpg cuts.jpg     # these

The built-in room is mapped on the command line, and shown and tuned in a browser. Needs the same as the
browser tests (playwright, extra dev; Debian's chromium) and the extra ``mesh``. make_room_picture.py and
make_clip.py make picture and clip of the front page.
"""

import io
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "tests" / "support"))  # the driver of the browser tests serves here too

import map_pictures  # noqa: E402
import page_pictures  # noqa: E402
from browser import LivePage, chromium  # noqa: E402
from live_program import LiveProgram  # noqa: E402
from PIL import Image  # noqa: E402

import taichi_mrf  # noqa: E402

IMAGES = REPOSITORY / "docs" / "images"
ROOM = "synthetic:room"
BUILDING = REPOSITORY.parent / "shared" / "data" / "lidar_building"
FEW_SCANS = ("--keyframes.translation", "2.5", "--keyframes.rotation", "0")
WIDTH = 1280
MOST_BYTES = 100_000
QUALITIES = range(80, 40, -4)
"""Qualities of JPEG, from which the best with a small enough file is chosen."""

Draw = Callable[[Any], Image.Image]

OF_A_MAP: dict[str, Draw] = {
    "level_map.jpg": map_pictures.level_map,
    "cuts.jpg": map_pictures.cuts,
    "mesh.jpg": map_pictures.mesh,
}
"""Drawn from the folder of a ``taichi-mrf map`` run, the same as that of ``make run``."""

OF_THE_LIVE_PAGE: dict[str, Draw] = {
    "live_cut.jpg": page_pictures.live_cut,
    "live_surface.jpg": page_pictures.live_surface,
    "live_keyframes.jpg": page_pictures.live_keyframes,
    "live_images.jpg": page_pictures.live_images,
    "live_baseline.jpg": page_pictures.live_baseline,
}
OF_THE_BUILDING: dict[str, Draw] = {"live_lidar.jpg": page_pictures.live_lidar}
"""Of the live page with a recording of ../shared/data."""

OF_THE_TUNING_PAGE: dict[str, Draw] = {
    "tune.jpg": page_pictures.tune_noise,
    "tune_panels.jpg": page_pictures.tune_panels,
}
"""Both show the tries of page_pictures.make_tries."""


def main() -> None:
    """Make what the arguments name, or everything."""
    known = [*OF_A_MAP, *OF_THE_LIVE_PAGE, *OF_THE_BUILDING, *OF_THE_TUNING_PAGE]
    wanted = sys.argv[1:] or known
    strange = sorted(set(wanted) - set(known))
    if strange:
        sys.exit(f"no such picture: {', '.join(strange)}; there are {', '.join(known)}")
    for pictures, source in (
        (OF_A_MAP, a_map),
        (OF_THE_LIVE_PAGE, the_live_page),
        (OF_THE_BUILDING, the_building),
        (OF_THE_TUNING_PAGE, the_tuning_page),
    ):
        if not set(wanted) & set(pictures):
            continue
        with source() as looked_at:
            for name, draw in pictures.items():
                if name in wanted:
                    write(draw(looked_at), IMAGES / name)


@contextmanager
def a_map() -> Iterator[Path]:
    """Map the room; yields the folder of the run."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "taichi_mrf", "map", ROOM, "--out", folder]
        subprocess.run(command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL)
        taichi_mrf.init()
        yield Path(folder)


def the_live_page() -> AbstractContextManager[LivePage]:
    """The live page of the whole room."""
    return _live_page(ROOM, "--voxel-size", "0.05")


def the_building() -> AbstractContextManager[LivePage]:
    """The live page of a real building by lidar."""
    return _live_page(str(BUILDING), "--voxel-size", "0.2", "--sensor.sigma", "0.12", *FEW_SCANS)


@contextmanager
def _live_page(*arguments: str) -> Iterator[LivePage]:
    with (
        LiveProgram(*arguments) as program,
        chromium() as browser,
        LivePage(browser, program.address, WIDTH, 800) as page,
    ):
        page.until_settled()
        yield page


@contextmanager
def the_tuning_page() -> Iterator[LivePage]:
    """The tuning page of twelve frames of the room."""
    with (
        LiveProgram(ROOM, "--voxel-size", "0.05", command="tune") as program,
        chromium() as browser,
        LivePage(browser, program.address, WIDTH, 1160) as page,
    ):
        page.until(lambda seen: seen.settled and seen.voxels, "the first map")
        page_pictures.make_tries(page)
        yield page


def write(picture: Image.Image, path: Path) -> None:
    """Write a JPEG of at most MOST_BYTES, or of the lowest quality."""
    for quality in QUALITIES:
        buffer = io.BytesIO()
        picture.save(buffer, "JPEG", quality=quality, optimize=True, progressive=True)
        if buffer.tell() <= MOST_BYTES:
            break
    path.write_bytes(buffer.getvalue())
    print(f"wrote {path.relative_to(REPOSITORY)}: {buffer.tell() / 1000:.0f} kB, quality {quality}")


if __name__ == "__main__":
    main()
