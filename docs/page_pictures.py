"""Operates the live page and the tuning page for the pictures of make_pictures.py.

Each function brings the page into the state of its name, takes a screenshot, and resets what it has changed,
so that any picture can follow.
"""

import io
import re

from browser import LivePage
from PIL import Image

TRIES = (
    ("Parameters", "Surface density (per m)", 5.0),
    ("Parameters", "Voxel size (m)", 0.08),
    ("Parameters", "Voxel size (m)", 0.04),
    ("Noise", "Sigma · 1 (m)", 0.004),
)
"""The changes before the pictures of the tuning page are taken: tab, slider, value."""

HIGH = 1440
"""Height in pixels of a window that fits the whole panel, with three images."""

STEADY_S = 10.0
"""Seconds without a change after which a map counts as complete."""


def shot(page: LivePage) -> Image.Image:
    """A screenshot after the page has drawn everything and without notices."""
    for button in page.page.locator(".mantine-Notification-closeButton").all():
        button.click()
    page.page.mouse.move(5, 5)  # away from the widgets, whose hints would show
    page.pause(1.5)
    return Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")


def level_cut(page: LivePage, share: float) -> None:
    """Cut the map at this share of its height."""
    page.select("Cut axis", "z")
    page.tick("Free space")
    slider = page.input("Cut at (m)").get_by_role("slider")
    low_m, high_m = (float(slider.get_attribute(f"aria-value{end}") or 0) for end in ("min", "max"))
    page.slide("Cut at (m)", round(low_m + share * (high_m - low_m), 2))


def live_cut(page: LivePage) -> Image.Image:
    """The map with a level cut at the height of the furniture."""
    page.tab("Map")
    level_cut(page, 0.3)
    page.until_settled()
    picture = shot(page)
    page.select("Cut axis", "none")
    page.until_settled()
    return picture


def live_surface(page: LivePage) -> Image.Image:
    """The measured surface by height, without the widgets."""
    page.tab("Map")
    page.show("surface", "height")
    page.until(lambda seen: seen.settled and seen.triangles, "the surface")
    picture = shot(page).crop((0, 85, 940, 705)).resize((480, 317), Image.Resampling.LANCZOS)
    page.show("voxels", "marginal probability")
    page.until_settled()
    return picture


def live_lidar(page: LivePage) -> Image.Image:
    """A building by lidar without its roof, from nearer, without the widgets."""
    page.tab("Map")
    page.show("voxels", "height")
    level_cut(page, 0.45)
    page.until_settled()
    page.page.mouse.move(480, 430)
    for _ in range(4):
        page.page.mouse.wheel(0, -240)
        page.pause(0.3)
    return shot(page).crop((0, 135, 940, 705)).resize((564, 342), Image.Resampling.LANCZOS)


def live_keyframes(page: LivePage) -> Image.Image:
    """A keyframe with the gizmo that moves it, the map coloured by the number of keyframes."""
    page.tab("Map")
    page.show("voxels", "keyframes that see it")
    page.tab("Keyframes")
    page.select("Keyframe", re.compile("room-0009"))
    page.press("Move")
    page.until(lambda seen: seen.settled and any("gizmo" in name for name in seen.nodes), "the gizmo")
    picture = shot(page)
    page.press("Move")
    page.tab("Map")
    page.show("voxels", "marginal probability")
    page.until_settled()
    return picture


def live_images(page: LivePage) -> Image.Image:
    """Measured and rendered depth and accuracy of a keyframe."""
    page.tab("Keyframes")
    page.select("Keyframe", re.compile("room-0009"))
    page.tab("Images")
    page.select("View", "chosen keyframe")
    page.tick("Show images")
    page.page.locator("img:visible").nth(2).wait_for()
    page.until(lambda seen: seen.settled, "images at rest")
    picture = panel(page)
    page.tick("Show images", on=False)
    return picture


def live_baseline(page: LivePage) -> Image.Image:
    """The map of OctoMap's update from the same keyframes, on the other side of a cut."""
    page.tab("Map")
    page.select("Cut axis", "x")
    page.tick("Baseline")
    page.until(lambda seen: seen.baseline, "the other map")
    counts: list[int] = []
    while len(counts) < 2 or counts[-1] != counts[-2]:  # it grows for as long as keyframes come
        page.pause(STEADY_S)
        counts.append(page.until(lambda seen: seen.settled, "the other map").baseline)
    picture = shot(page)
    page.tick("Baseline", on=False)
    page.select("Cut axis", "none")
    page.until(lambda seen: seen.settled and not seen.baseline, "one map")
    return picture


def make_tries(page: LivePage) -> None:
    """Make the tries of TRIES, with the first as the reference, for all pictures of the tuning page."""
    for number, (tab, label, value) in enumerate(TRIES, start=1):
        page.tab(tab)
        page.slide(label, value)
        page.until(lambda seen, n=number: seen.settled and f"Try {n}" in page.text(), f"try {number} at rest")
    page.tab("Tries")
    page.select("Selected try", re.compile("^1: "))
    page.press("Pin")
    page.until(lambda seen: "against try 1" in page.text(), "the reference")


def tune_noise(page: LivePage) -> Image.Image:
    """Map, scores, and the residuals with the curves of bias and sigma."""
    page.tab("Noise")
    page.page.locator(".uplot canvas").first.wait_for(state="visible")
    return shot(page)


def tune_panels(page: LivePage) -> Image.Image:
    """The table of tries beside a held-out view of the reference and of the current try."""
    page.tab("Tries")
    tries = panel(page)
    page.tab("Views")
    page.until(lambda seen: page.page.locator("img").count() >= 2, "where the maps are right, the depths")
    return side_by_side(tries, panel(page))


def panel(page: LivePage) -> Image.Image:
    """A screenshot of the whole open tab, without the rest of the page."""
    size = page.page.viewport_size
    assert size is not None
    page.page.set_viewport_size({"width": size["width"], "height": HIGH})
    page.pause(1.0)
    box = page.page.locator(".mantine-Paper-root").first.bounding_box()
    tabs = page.page.get_by_role("tab").first.bounding_box()
    assert box is not None
    assert tabs is not None
    edges = box["x"], tabs["y"], box["x"] + box["width"], box["y"] + box["height"]
    picture = shot(page).crop(tuple(map(int, edges)))
    page.page.set_viewport_size(size)
    return picture


def side_by_side(*pictures: Image.Image) -> Image.Image:
    """Pictures in a row on white, aligned at the top."""
    size = sum(each.width for each in pictures), max(each.height for each in pictures)
    row = Image.new("RGB", size, "white")
    left = 0
    for picture in pictures:
        row.paste(picture, (left, 0))
        left += picture.width
    return row
