"""Adding keyframes to a map and removing them: their bricks, their visible bricks and their messages."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from taichi_mrf.config.schema import SensorConfig, VolumeConfig
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.inference import leave
from taichi_mrf.inference.footprint import find_footprint
from taichi_mrf.inference.incremental import change_count_of
from taichi_mrf.inference.keyframe import DepthImage, Footprint, Keyframe, NoReturnRays, RayList
from taichi_mrf.inference.keyframe_bounds import KeyframeBounds
from taichi_mrf.inference.messages import carry_over, new_messages, withdraw_messages
from taichi_mrf.inference.ray_list import RayBundler
from taichi_mrf.methods.brick_registry import BrickRegistry
from taichi_mrf.methods.mrf.memory_budget import MemoryBudget
from taichi_mrf.system import runtime
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.later import later
from taichi_mrf.voxels.numbering import strip_length

if TYPE_CHECKING:
    from taichi_mrf.inference import no_returns
    from taichi_mrf.inference.dated import DatedBelief
else:
    (no_returns,) = later("taichi_mrf.inference", "no_returns")


@dataclass(frozen=True)
class KeyframeAllocator:
    """Allocates and releases what the keyframes of one map need."""

    registry: BrickRegistry
    bundler: RayBundler
    sensor: SensorConfig
    volume: VolumeConfig
    precision: str
    bounds: KeyframeBounds
    budget: MemoryBudget
    dated: "DatedBelief | None" = None
    """Dated beliefs that follow the messages, if evidence has a date."""

    def place(self, id: int, name: str, image: DepthImage, T_world_camera: Pose, stamp_s: float) -> Keyframe:
        """Find the bricks that a keyframe's rays cross and claim those near its surfaces. Raises
        CapacityError if there is not enough memory."""
        # A ray stands for each block of pixels that say the same: one factor psi_r each, eq. 4.
        rays, without = self.bundler.rays_of(image), tuple[NoReturnRays, ...]()
        if image.own.no_return is not None:
            without = no_returns.no_return_rays(image, self.sensor, self.bundler)
        return self._placed(id, name, image, rays, T_world_camera, stamp_s, without)

    def place_again(self, keyframe: Keyframe, image: DepthImage, T_world_camera: Pose) -> Keyframe:
        """Place a keyframe at another pose, after :meth:`take_out`. Its rays stay the same if its image does.
        Raises CapacityError if there is not enough memory."""
        if image is not keyframe.image:
            return self.place(keyframe.id, keyframe.name, image, T_world_camera, keyframe.stamp_s)
        parts = (image, keyframe.ray_list, T_world_camera, keyframe.stamp_s)
        return self._placed(keyframe.id, keyframe.name, *parts, keyframe.no_returns)

    def _placed(
        self, id: int, name: str, image: DepthImage, rays: RayList, T_world_camera: Pose, stamp_s: float,
        no_returns: tuple[NoReturnRays, ...],
    ) -> Keyframe:  # fmt: skip
        """Find the footprint of rays and claim it, if there is enough memory."""
        # The voxels o_1 .. o_N of each ray lie in the bricks that it crosses up to 3 sigma behind d_r.
        parts = (self.registry.voxel_size, self.sensor, self.volume)
        footprint = find_footprint(image, rays, T_world_camera, *parts, no_returns=no_returns)
        of_no_returns = sum(each.nbytes for each in no_returns)
        self.budget.check(footprint, image.nbytes + rays.nbytes + of_no_returns)
        self.registry.anchor_at(T_world_camera[:3, 3])
        return self._claimed(id, name, image, rays, T_world_camera, stamp_s, footprint, no_returns)

    def put_back(self, keyframe: Keyframe) -> Keyframe:
        """Place a keyframe again, without messages, right after :meth:`take_out`. The memory that it needs
        was just released, so the budget is not checked."""
        parts = (keyframe.image, keyframe.ray_list, keyframe.T_world_camera, keyframe.stamp_s)
        return self._claimed(keyframe.id, keyframe.name, *parts, keyframe.footprint, keyframe.no_returns)

    def _claimed(
        self, id: int, name: str, image: DepthImage, rays: RayList, T_world_camera: Pose, stamp_s: float,
        footprint: Footprint, no_returns: tuple[NoReturnRays, ...],
    ) -> Keyframe:  # fmt: skip
        """Claim the bricks and return the keyframe, counted in the budget."""
        visible = self.registry.claim(footprint)
        self.bounds.put(id, footprint.window)
        placed = (T_world_camera, stamp_s, footprint, visible)
        keyframe = Keyframe(id, name, image, rays, *placed, no_returns=no_returns)
        self.budget.take(keyframe)
        return keyframe

    def take_out(self, keyframe: Keyframe) -> None:
        """Undo :meth:`place` and subtract the keyframe's messages from the beliefs."""
        self.withdraw(keyframe)
        self.registry.disclaim(keyframe.footprint)
        self.bounds.drop(keyframe.id)
        self.budget.give_back(keyframe.id)
        runtime.settle()  # before its arrays are dropped

    def withdraw(self, keyframe: Keyframe) -> None:
        """Subtract a keyframe's messages from the beliefs and drop them. It keeps its bricks, and is as one
        that was never swept."""
        if keyframe.messages is None:
            return
        pool, messages, slots = self.registry.pool, self.refresh(keyframe), keyframe.visible.slots
        if len(slots):
            pool.count_changes(slots, withdraw_messages(keyframe.visible, messages, pool.total))
            pool.revision += 1
            pool.touch(slots)
            if self.dated is not None:
                self.dated.withdraw(keyframe)
        keyframe.messages = None
        self.budget.mark_unallocated(keyframe.id)

    def freeze(self, keyframe: Keyframe) -> None:
        """Add a keyframe's messages to the evidence that inference starts from. Its bricks stay."""
        pool, messages = self.registry.pool, self.refresh(keyframe)
        if len(keyframe.visible.slots):
            leave.fold(keyframe.visible.slots, pool.keep_evidence(), messages, strip_length())
            if self.dated is not None:
                self.dated.freeze(keyframe)
        self.registry.freeze(keyframe.footprint)
        self.bounds.drop(keyframe.id)
        self.budget.give_back(keyframe.id)
        pool.touch(keyframe.visible.slots)
        runtime.settle()  # before its arrays are dropped

    def mark_without_messages(self, keyframes: Iterable[Keyframe]) -> None:
        """Reserve memory for the messages of those keyframes that have none."""
        for keyframe in keyframes:
            if keyframe.messages is None:
                self.budget.mark_unallocated(keyframe.id)

    def look_again(self, keyframe: Keyframe) -> None:
        """Update a keyframe's list of visible bricks and leave its messages as they are."""
        seen = keyframe.visible if keyframe.pending_visible is None else keyframe.pending_visible
        visible = self.registry.visible_again(keyframe.footprint, seen)
        counted = keyframe.change_count_at_last_sweep
        if visible is not seen:
            keyframe.pending_visible = visible
            if counted is not None:
                keyframe.change_count_at_last_sweep = change_count_of(visible, seen, counted)

    def refresh(self, keyframe: Keyframe) -> "ti.Ndarray":
        """Bring a keyframe's visible bricks and messages up to date. Newly visible bricks start without a
        message (log-odds 0)."""
        old, old_messages = keyframe.visible, keyframe.messages
        self.look_again(keyframe)
        if keyframe.pending_visible is not None:
            keyframe.visible, keyframe.pending_visible = keyframe.pending_visible, None
        if old_messages is None or keyframe.visible is not old:
            keyframe.messages = new_messages(keyframe.visible, self.precision)
            self.budget.mark_allocated(keyframe.id)
            keyframe.revision = -1
            if old_messages is None:
                keyframe.change_count_at_last_sweep = None  # they were never swept
            else:
                carry_over(old, old_messages, keyframe.visible, keyframe.messages)
        assert keyframe.messages is not None
        return keyframe.messages
