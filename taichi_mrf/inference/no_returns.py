"""The rays of pixels that got no return: which they are, and what they tell voxels."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.inference import sum_product
from taichi_mrf.inference.accumulators import length_sum
from taichi_mrf.inference.keyframe import DepthImage, NoReturnRays
from taichi_mrf.inference.ray_list import RayBundler
from taichi_mrf.inference.ray_model import RayModel, SweptVoxels, Trace
from taichi_mrf.inference.workers import Workers
from taichi_mrf.sensor.no_return import NoReturnLaw
from taichi_mrf.sensor.own_evidence import free_up_to_m
from taichi_mrf.system.bundles import kernel
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, I64Array
from taichi_mrf.voxels.traversal import Space, Viewpoint


def no_return_rays(image: DepthImage, config: SensorConfig, bundler: RayBundler) -> tuple[NoReturnRays, ...]:
    """The rays of the pixels of an image that got no return: those that say up to which depth, and those of
    the configuration's law, if they count.

    They are bundled as if all had measured the depth up to which they count: there a voxel covers the fewest
    pixels.
    """
    assert image.own.no_return is not None
    free_m, found = free_up_to_m(image.own.no_return), list[NoReturnRays]()
    sure, unsure = NoReturnLaw.sure(config), NoReturnLaw.of(config)
    for law, until_m in ((sure, free_m), (unsure, np.where(free_m < 0, np.inf, 0))):
        if law is not None and (until_m > 0).any():
            depth = np.clip(until_m, 0, law.reach_m).astype(np.float32)
            without = DepthImage.upload(depth, image.camera, law)
            rays = bundler.rays_of(without)
            found.append(NoReturnRays(without, rays, law.begin_m, law.reach_m, law is sure))
    return tuple(found)


def send_no_returns(
    no_returns: Sequence[NoReturnRays], sums: "ti.Ndarray", view: Viewpoint, space: Space,
    model: RayModel, swept: SweptVoxels, trace: Trace, workers: Workers,
) -> None:  # fmt: skip
    """Sum up the messages of rays without a return in ``sums``, as measured ones are in ``swept.sums``.

    Chances take the place of densities. Each missing return is explained by one of them, so no floor is
    added.
    """
    sums.fill(0)
    for each in no_returns:
        sum_product.send_messages(
            each.ray_list, each.begin_m, each.image.sensor, view, space,
            replace(model, max_depth=each.reach_m, floor=0.0),
            replace(swept, sums=sums),
            trace, workers,
        )  # fmt: skip


@kernel
def take_where_unmeasured(
    number: I32, sums: I64Array, of_no_returns: I64Array, scale: F32, least: F32
) -> None:
    """Take the sums of the rays without a return where a keyframe's measured rays have crossed a voxel for no
    more than ``least`` voxel sizes. Both are (visible bricks * 512), ``number`` long.

    Missing returns beside measured ones are no further evidence: the rays that meet one dark or wet surface
    have the same reason to give none.
    """
    for i in range(number):
        if length_sum(sums[i], scale) <= least:
            sums[i] = of_no_returns[i]
