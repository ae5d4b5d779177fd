"""Makes docs/images/loop_closure.gif and loop_closure.png: a loop is closed, 300 keyframes move, and the map
re-forms, seen from above; beside it the seconds in which OctoMap and Open3D make their maps anew.

    python docs/make_loop_clip.py

The walk is that of benchmarks/loop_closure.py. The seconds are those of the machine that makes the pictures,
so nothing else should run on it. Needs the extra ``bench``.
"""

import io
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY / "benchmarks"))

from loop_closure import (  # noqa: E402
    USABLE_POINTS,
    Clock,
    Judge,
    Walk,
    built,
    closed,
    rebuilt_by_others,
    warm_up,
)

from taichi_mrf import MRFMap  # noqa: E402
from taichi_mrf.evaluation.pictures.figures import new_figure  # noqa: E402
from taichi_mrf.system import runtime  # noqa: E402

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGES = REPOSITORY / "docs" / "images"
VOXEL_SIZE, STEP_S = 0.05, 0.25
WIDTH = 680
LOWER_M, UPPER_M = (-11.8, -7.0), (11.8, 7.0)
"""Corners of the picture, x and y."""

CEILING_M = 1.1
"""Height above which all is left out, in the world's z; the floor is at -1.2."""

FLOOR_M = -1.25
COLORS = 24
LAST_MS = 4000

DETAIL_M = (-1.5, 8.0), (-6.5, -3.7)
"""x and y of the part where the walk meets its beginning."""

GROUND, SKY, LOW, HIGH = (255, 255, 255), (255, 255, 255), (222, 226, 230), (33, 37, 51)
WAITING, MOVED, STAYS = (230, 0, 126), (0, 150, 136), (150, 155, 165)


@dataclass(frozen=True)
class Shot:
    """State of the map after so many seconds: heights seen from above, where the cameras are, (N, 2) metres,
    how many of them are still to move, and which moment this is."""

    heights_m: NDArray[np.float64]
    cameras_m: NDArray[np.float64]
    waits: NDArray[np.bool_]
    seconds: float
    moment: str
    usable: bool = False


def main() -> None:
    """Close the loop once and write both files."""
    runtime.init("auto")
    walk = Walk(500, 300)
    anew_s = Clock()
    with anew_s.running():
        anew = built(walk.keyframes, walk.true, VOXEL_SIZE)
    judge = Judge(anew, walk.held_out())
    m = built(walk.keyframes, walk.drifted, VOXEL_SIZE)
    warm_up(walk.keyframes, VOXEL_SIZE)

    clock = Clock()
    shots, usable = [shot(walk, m, clock, "the loop is found")], False
    for left in closed(m, walk.true, STEP_S, clock):
        moment = f"{walk.moved - left} of {walk.moved} moved" if left else "all moved, others swept again"
        usable = usable or judge.row(moment, m, clock) <= USABLE_POINTS
        shots.append(shot(walk, m, clock, moment, usable))
    with clock.running():
        m.infer()
    if not judge.equal(m):
        raise SystemExit("the map is not the one made anew")
    shots.append(shot(walk, m, clock, "inferred: bit for bit the map made anew"))
    others_s = rebuilt_by_others(walk.keyframes, VOXEL_SIZE)
    write_clip(walk, shots, others_s, IMAGES / "loop_closure.gif")
    write_figure(walk, shots, {"taichi_mrf": anew_s.wall, **others_s}, IMAGES / "loop_closure.png")


def shot(walk: Walk, m: MRFMap, clock: Clock, moment: str, usable: bool = False) -> Shot:
    """The map now."""
    poses = [keyframe.T_world_camera for keyframe in m.keyframes.values()]
    waits = [not np.array_equal(T, walk.true[number]) for number, T in enumerate(poses)]
    heights_m = top_view(m.voxels(0.5)[0])
    return Shot(heights_m, np.array(poses)[:, :2, 3], np.array(waits), clock.wall, moment, usable)


def top_view(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height in metres of the highest of the voxels (N, 3) under the ceiling, (rows, columns) with y upwards,
    NaN where there is none."""
    shape = np.round((np.array(UPPER_M) - LOWER_M) / VOXEL_SIZE).astype(int)
    heights = np.full(shape, -np.inf)
    kept = centres[centres[:, 2] < CEILING_M]
    cells = np.floor((kept[:, :2] - LOWER_M) / VOXEL_SIZE).astype(int)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    np.maximum.at(heights, tuple(cells[inside].T), kept[inside, 2])
    return np.where(np.isfinite(heights), heights, np.nan).T[::-1]


def write_clip(walk: Walk, shots: list[Shot], others_s: dict[str, float], path: Path) -> None:
    """Write the GIF, which plays as fast as the map re-formed up to the last picture."""
    pictures = [drawn(walk, each, others_s) for each in shots]
    palette = pictures[len(pictures) // 2].quantize(COLORS, dither=Image.Dither.NONE)
    small = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    gaps_s = np.diff([each.seconds for each in shots[:-1]])
    milliseconds = [1500, *(10 * round(100 * gap) for gap in gaps_s.tolist()), LAST_MS]
    small[0].save(path, save_all=True, append_images=small[1:], duration=milliseconds, loop=0, optimize=True)
    print(f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB, {len(small)} pictures")


def drawn(walk: Walk, now: Shot, others_s: dict[str, float]) -> Image.Image:
    """One picture of the clip: the building from above, and in its middle the detail and the bars."""
    picture = shaded(now.heights_m)
    picture = picture.resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.BOX)
    draw = ImageDraw.Draw(picture)
    metre = WIDTH / (UPPER_M[0] - LOWER_M[0])
    for number, (place, waits) in enumerate(zip(now.cameras_m, now.waits, strict=True)):
        x, y = (place[0] - LOWER_M[0]) * metre, (UPPER_M[1] - place[1]) * metre
        draw.rectangle([x - 1, y - 1, x + 1, y + 1], fill=camera_color(number < walk.stay, bool(waits)))
    left, top, width = 150, 92, 380
    draw.text((left, top), f"{now.seconds:.1f} s", fill=HIGH, font=font(26))
    draw.text((left + 105, top + 10), now.moment, fill=HIGH, font=font(13))
    part = detail(now.heights_m, width)
    picture.paste(part, (left, top + 36))
    top += 44 + part.height
    for name, seconds in others_s.items():
        share = min(1.0, now.seconds / seconds)
        text = f"{name} from all frames: {seconds:.0f} s" + (", done" if share == 1.0 else "")
        draw.text((left, top), text, fill=HIGH, font=font(11))
        draw.rectangle([left, top + 15, left + width, top + 20], fill=LOW)
        draw.rectangle([left, top + 15, left + round(share * width), top + 20], fill=STAYS)
        top += 26
    return picture


def camera_color(stays: bool, waits: bool) -> tuple[int, int, int]:
    """The colour of a keyframe's dot."""
    return STAYS if stays else WAITING if waits else MOVED


def shaded(heights_m: NDArray[np.float64]) -> Image.Image:
    """Voxels from above: the higher, the darker."""
    share = np.clip((np.nan_to_num(heights_m) - FLOOR_M) / (CEILING_M - FLOOR_M), 0.0, 1.0)[..., None] ** 0.8
    colors = (1 - share) * np.array(LOW) + share * np.array(HIGH)
    return Image.fromarray(np.where(np.isnan(heights_m)[..., None], GROUND, colors).astype(np.uint8))


def detail(heights_m: NDArray[np.float64], width: int) -> Image.Image:
    """The part where the walk meets its beginning, so many pixels wide."""
    (x0, x1), (y0, y1) = DETAIL_M
    columns = [round((x - LOWER_M[0]) / VOXEL_SIZE) for x in (x0, x1)]
    rows = [round((UPPER_M[1] - y) / VOXEL_SIZE) for y in (y1, y0)]
    part = shaded(heights_m[rows[0] : rows[1], columns[0] : columns[1]])
    return part.resize((width, round(width * part.height / part.width)), Image.Resampling.NEAREST)


def font(size: int) -> ImageFont.FreeTypeFont:
    """Matplotlib's own font, which every machine with it has."""
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", size)


def write_figure(walk: Walk, shots: list[Shot], others_s: dict[str, float], path: Path) -> None:
    """Write the figure: the detail at four moments, and the seconds of all as bars."""
    usable = next((each for each in shots if each.usable), shots[-2])
    moments = [
        (shots[0], "before: the end of the walk stands beside its beginning"),
        (usable, f"after {usable.seconds:.1f} s: usable, {usable.moment}"),
        (shots[-2], f"after {shots[-2].seconds:.1f} s: all moved and swept"),
        (shots[-1], f"after {shots[-1].seconds:.1f} s: inferred, bit for bit the map made anew"),
    ]
    bars = {
        "update_poses, usable": usable.seconds,
        "all moved and swept": shots[-2].seconds,
        "inferred, exact": shots[-1].seconds,
        **{f"{name} anew": seconds for name, seconds in others_s.items()},
    }
    figure = new_figure(9.4, 5.2)
    layout = figure.add_gridspec(3, 2, height_ratios=[1.0, 1.0, 1.15])
    for number, (each, title) in enumerate(moments):
        ax = figure.add_subplot(layout[number // 2, number % 2])
        ax.imshow(np.asarray(detail(each.heights_m, 950)), interpolation="nearest")
        ax.set_title(title, fontsize=9, loc="left")
        ax.axis("off")
    ax = figure.add_subplot(layout[2, :])
    colors = ["#009688"] * 3 + ["#969ba5"] * (len(bars) - 3)
    ax.bar_label(ax.barh(list(bars), list(bars.values()), color=colors), fmt="%.1f s", padding=3, fontsize=9)
    ax.invert_yaxis()
    ax.tick_params(labelsize=9)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel(f"seconds; {walk.moved} of {len(walk.keyframes)} keyframes move by 1 to 30 cm", fontsize=9)
    small(figure).save(path, optimize=True)
    print(f"wrote {path}: {path.stat().st_size / 1e6:.2f} MB")


def small(figure: "Figure") -> Image.Image:
    """The figure in few colours, for a small file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return Image.open(buffer).convert("RGB").quantize(64, dither=Image.Dither.NONE)


if __name__ == "__main__":
    main()
