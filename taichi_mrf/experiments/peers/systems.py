"""The systems and their settings, from fast to thorough."""

from collections.abc import Sequence

from taichi_mrf.datasets.lidar.scans import LIDAR_PASS_THROUGH
from taichi_mrf.experiments.peers.octomap import OctomapPeer
from taichi_mrf.experiments.peers.our_maps import BONXAI, NO_OTHERS, MrfPeer, log_odds, visibility, wavemap
from taichi_mrf.experiments.peers.peer import Knob, System
from taichi_mrf.experiments.peers.tsdf import TsdfPeer

ALONE = {"renew_tolerance": NO_OTHERS}
"""Earlier keyframes keep their messages."""

MRF = "MRFMap"


def systems(lidar: bool) -> Sequence[System]:
    """All of them; on a lidar without those that take images only."""
    return [system for system in (_mrf(lidar), *_OTHERS) if not (lidar and system.images_only)]


def _mrf(lidar: bool) -> System:
    beam = {"pass_through": LIDAR_PASS_THROUGH} if lidar else {}
    coarse = Knob("1/8, 0.25 rays per cm, alone", 8, {"ray_density": 0.25, **ALONE, **beam})
    standard = Knob("all pixels, re-inference", 1, beam, standard=True)
    knobs = [
        coarse.of_keyframes(),
        coarse,
        Knob("1/8, 0.5 rays per cm, alone", 8, {"ray_density": 0.5, **ALONE, **beam}),
        Knob("1/4, 1 ray per cm, alone", 4, {"ray_density": 1.0, **ALONE, **beam}),
        Knob("1/2, re-inference", 2, beam),
        Knob("all pixels, alone", 1, {**ALONE, **beam}),
        standard.of_keyframes(),
        standard,
        Knob("all pixels, three full sweeps", 1, {"full_sweeps": 3, **ALONE, **beam}),
    ]
    return System(MRF, MrfPeer, knobs)


def _strided(strides: Sequence[int], **parameters: object) -> list[Knob]:
    """A setting for each stride; the one with all pixels is the standard."""
    return [Knob(_pixels(stride), stride, parameters, standard=stride == 1) for stride in strides]


def _octomap() -> list[Knob]:
    """One ray for each voxel that is hit, and at last one for each pixel."""
    cheap = [
        Knob(f"{_pixels(stride)}, a ray per voxel", stride, {"discretise": True}) for stride in (8, 4, 1)
    ]
    full = Knob("all pixels", 1, standard=True)
    return [*cheap, full.of_keyframes(), full]


def _tsdf() -> list[Knob]:
    """A narrow truncation, which suits coarse voxels better, and Open3D's default of 8 voxels."""
    narrow, wide = {"truncation": 4.0}, {"truncation": 8.0}
    full = Knob("all pixels", 1, narrow, standard=True)
    thin = Knob("1/4", 4, narrow)
    return [thin.of_keyframes(), thin, full, Knob("all pixels, truncation 8", 1, wide)]


def _pixels(stride: int) -> str:
    return f"1/{stride}" if stride > 1 else "all pixels"


_OTHERS = (
    System("OctoMap", OctomapPeer, _octomap()),
    System("hit/miss (Bonxai)", log_odds, _strided((8, 4, 1), **BONXAI)),
    System("log-odds", log_odds, _strided((8, 4, 1))),
    System("visibility", visibility, _strided((4, 1))),
    System("wavemap's model", wavemap, _strided((8, 4, 1))),
    System("TSDF (Open3D)", TsdfPeer, _tsdf(), images_only=True),
)
