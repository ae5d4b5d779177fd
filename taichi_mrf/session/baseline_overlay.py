"""The baseline: the same keyframes mapped by OctoMap's method, shown next to the map on demand."""

from dataclasses import replace

import numpy as np

from taichi_mrf.config.registry import octomap_method
from taichi_mrf.config.schema import Config, without_window
from taichi_mrf.config.time import TimeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference.schedule import Progress
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.noise import NoiseModel
from taichi_mrf.session.mapper import Mapper
from taichi_mrf.session.publish import Publisher
from taichi_mrf.viewer.messages import Bricks

LEAST_LOG_ODDS = 0.0
"""Bricks without any voxel more likely occupied than not are not sent: in this map every brick that a ray
crosses exists, seven in ten of them free at 2 cm, and a voxel seen to be free never falls below 0.12."""


class BaselineOverlay:
    """A map by OctoMap's method that follows a mapper's keyframes, one piece of work at a time."""

    def __init__(self, config: Config, noise: NoiseModel) -> None:
        """An empty map with a configuration's parameters, but for the window, which its method lacks, and
        for time: OctoMap's update forgets nothing."""
        static = replace(without_window(config), time=TimeConfig())
        self.map: OccupancyMap = octomap_method().load_class().with_noise(static, noise)
        self._publisher = Publisher(
            "baseline",
            self.map.view.pool,
            self.map.seen_by,
            prior_is_unknown=True,
            least_log_odds=LEAST_LOG_ODDS,
        )
        self._places: dict[int, tuple[int, Pose]] = {}
        """The viewer's number of a keyframe -> its number and pose here."""
        self._stale = False

    def catch_up(self, mapper: Mapper, progress: Progress) -> bool:
        """Do one piece of the work that is left: add a keyframe, or integrate all anew after some have gone
        or moved, which ``progress`` can stop. Returns whether there was any.

        A frozen keyframe that is in this map stays in it; one that was frozen before cannot be added.
        """
        entries = mapper.roster.entries
        for id, (here, pose) in list(self._places.items()):
            entry = entries.get(id)
            if entry is None or entry.state == "off":
                self.map.remove_keyframe(here)
                del self._places[id]
                self._stale = True
            elif not np.array_equal(entry.T_world_camera, pose):
                self.map.move_keyframe(here, entry.T_world_camera)
                self._places[id] = here, entry.T_world_camera
                self._stale = True
        if self._stale:
            self._stale = not self.map.infer(progress=progress).complete
            return True
        for entry in mapper.roster.with_state("on"):
            if entry.id not in self._places:
                image = mapper.posed_image(entry)
                parts = (entry.T_world_camera, entry.camera, entry.name, entry.stamp_s)
                here = self.map.add_keyframe(image.depth_m, *parts, **image.own.arguments())
                self._places[entry.id] = here, entry.T_world_camera
                return True
        return False

    def changes(self) -> Bricks | None:
        """The changes that were not sent yet; None while the map is being rebuilt."""
        return None if self._stale else self._publisher.changes()

    def start_over(self) -> None:
        """Send the whole map with the next changes: the viewer is a new one."""
        self._publisher.start_over()

    def everything_gone(self) -> Bricks:
        """The update that removes this map from the page."""
        return self._publisher.everything_gone()
