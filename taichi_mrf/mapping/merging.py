"""Merges several maps of one place: each is located in the others, then one pose graph covers all overlaps.

The first map stays where it is. A map that is not found in it may be found in another that was. Keyframes of
two maps that see the same are aligned with each other, as where a loop is closed (loops.py), and the graph of
these steps and of those within each map moves the keyframes of the later maps a little. What frozen keyframes
have left is moved to where its map was found, as evidence.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from taichi_mrf.alignment.locate_recording import LocatedRecording, locate_any
from taichi_mrf.alignment.oriented_points import oriented_points
from taichi_mrf.alignment.pairs import loop
from taichi_mrf.alignment.pose_graph import solve_pose_graph
from taichi_mrf.alignment.rules import RULES
from taichi_mrf.alignment.scan import scans_of
from taichi_mrf.config.registry import methods_with
from taichi_mrf.errors import ConfigError, DatasetError
from taichi_mrf.geometry.pose_edge import PoseEdge
from taichi_mrf.geometry.poses import Pose, as_pose, inverse, tangent_norms
from taichi_mrf.inference.keyframe import Keyframe
from taichi_mrf.mapping.onto import free_prefix, locate, whole_map
from taichi_mrf.methods.capabilities import can_refine_poses
from taichi_mrf.methods.mrf.map import MRFMap
from taichi_mrf.methods.mrf.moved_evidence import check
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.sensor.frame import Frame


@dataclass(frozen=True)
class Merged:
    """One ``map`` of several, inferred. ``located`` is where each of the others lies in the first; ``loops``
    is the number of measured steps between keyframes of different maps that are believed, and ``moved_m`` the
    most that they have moved a keyframe against its own map, metres."""

    map: MRFMap
    located: tuple[LocatedRecording, ...]
    loops: int
    moved_m: float


@dataclass(frozen=True)
class _Node:
    """A keyframe of the map with a ``number``, which stands ``place``-th in it."""

    number: int
    place: int
    keyframe: Keyframe


def merge(maps: Sequence[OccupancyMap], names: Sequence[str] = ()) -> Merged:
    """Merge maps of one place into the first. ``names`` are for messages.

    Raises ConfigError for fewer than two maps, for one whose keyframes cannot be aligned, for a later one
    whose frozen evidence cannot be moved (MRFMap.take_in), and DatasetError for one that is in no other.
    """
    called = list(names) or [f"map {number}" for number in range(1, len(maps) + 1)]
    parts = _checked(maps, called)
    # Each map in the world of the first.
    located = _located(parts, called)
    T_first_map = [np.eye(4), *(_known(place) for place in located)]
    nodes = [
        _Node(number, place, keyframe)
        for number, m in enumerate(parts)
        for place, keyframe in enumerate(m.keyframes.values())
    ]
    placed = {n: T_first_map[node.number] @ node.keyframe.T_world_camera for n, node in enumerate(nodes)}
    # The poses that fit the steps between the maps and the shape of each best.
    loops = list(_steps_between(parts, nodes, placed))
    worlds = {len(nodes) + number: T for number, T in enumerate(T_first_map)}
    fixed = [len(nodes), *(n for n, node in enumerate(nodes) if node.number == 0)]
    solution = solve_pose_graph(placed | worlds, [*_shapes(nodes), *loops], fixed)
    trust = solution.trust[len(nodes) :]
    # All keyframes in one map.
    m = parts[0]
    for number, part in enumerate(parts):
        prefix = free_prefix(m, [keyframe.name for keyframe in part.keyframes.values()])
        for n, node in enumerate(nodes):
            if node.number == number > 0:
                _add(m, part, node.keyframe, as_pose(solution.poses[n]), prefix)
        if number > 0 and part.frozen:
            m.take_in(part, T_first_map[number])
    m.infer()
    moved = (tangent_norms(placed[n], solution.poses[n])[1] for n in range(len(nodes)))
    moved_m = max(moved, default=0.0)
    return Merged(m, tuple(located), int((trust > RULES.trusted).sum()), moved_m)


def lay_over(a: OccupancyMap, b: OccupancyMap) -> LocatedRecording | None:
    """Move the keyframes of map b to where they lie in the world of map a, and infer it, unless it stands
    there already. Returns where it was found, or why not; None if it stands there, or if keyframes of one of
    the maps cannot be aligned, or are frozen."""
    if not (can_refine_poses(a) and can_refine_poses(b)) or a.frozen or b.frozen:
        return None
    if not (a.keyframes and b.keyframes):
        return None
    frames = [frame_of(keyframe) for keyframe in b.keyframes.values()]
    if locate(a, frames, np.eye(4)).T_map_recording is not None:
        return None
    found = locate(a, frames)
    if found.T_map_recording is not None:
        for id, keyframe in b.keyframes.items():
            b.move_keyframe(id, as_pose(found.T_map_recording @ keyframe.T_world_camera))
        b.infer()
    return found


def _checked(maps: Sequence[OccupancyMap], names: Sequence[str]) -> list[MRFMap]:
    if len(maps) < 2:
        raise ConfigError("there is nothing to merge: pass two maps or more")
    parts: list[MRFMap] = []
    for m, name in zip(maps, names, strict=True):
        if not can_refine_poses(m):
            needed = methods_with("can_refine_poses")
            raise ConfigError(f"{name}: maps of the method {needed} can be merged, not {m.METHOD.name}")
        if m.frozen and parts:
            check(parts[0].config, m.config, m.window, name)
        parts.append(m)
    return parts


def _known(located: LocatedRecording) -> Pose:
    assert located.T_map_recording is not None
    return located.T_map_recording


def _located(parts: Sequence[MRFMap], names: Sequence[str]) -> list[LocatedRecording]:
    """Place of each map but the first in the world of that. Raises DatasetError."""
    known: dict[int, LocatedRecording] = {0: LocatedRecording(np.eye(4))}
    reasons: dict[int, str] = {}
    asked: set[tuple[int, int]] = set()
    while len(known) < len(parts):
        pairs = [(i, j) for i in range(len(parts)) if i not in known for j in known if (i, j) not in asked]
        if not pairs:
            lost = min(set(range(len(parts))) - known.keys())
            raise DatasetError(f"{names[lost]}: not found in any other map: {reasons[lost]}")
        for number, other in pairs:
            if number in known:
                continue
            asked.add((number, other))
            found = _found(parts[number], parts[other])
            if found.T_map_recording is None:
                reasons.setdefault(number, found.reason)
            else:
                T = _known(known[other]) @ found.T_map_recording
                known[number] = replace(found, T_map_recording=T)
    return [known[number] for number in range(1, len(parts))]


def _found(m: MRFMap, other: MRFMap) -> LocatedRecording:
    """Location of a map in another: by its keyframes, or by its voxels if any keyframe is frozen."""
    if not m.frozen:
        return locate(other, [frame_of(keyframe) for keyframe in m.keyframes.values()])
    scans = list(scans_of(m, whole_map(m)))
    return locate_any(scans, whole_map(other), nothing="too little seen: it has no free space")


def frame_of(keyframe: Keyframe) -> Frame:
    """A keyframe of a map as the frame that it was."""
    return Frame(
        keyframe.depth_m,
        keyframe.T_world_camera,
        keyframe.camera,
        keyframe.stamp_s,
        keyframe.name,
        color=keyframe.color,
        sigma_m=keyframe.own.sigma_m,
        noise=keyframe.own.noise,
        no_return=keyframe.own.no_return,
        images=keyframe.own.images,
    )


def _shapes(nodes: Sequence[_Node]) -> Iterator[PoseEdge]:
    """The pose of each keyframe in the world of its own map, whose node comes after all keyframes."""
    information = np.diag(np.repeat([RULES.merged_m, RULES.merged_rad], 3) ** -2.0)
    for n, node in enumerate(nodes):
        yield PoseEdge(len(nodes) + node.number, n, node.keyframe.T_world_camera, information)


def _steps_between(
    parts: Sequence[MRFMap], nodes: Sequence[_Node], placed: dict[int, Pose]
) -> Iterator[PoseEdge]:
    """Measured steps from keyframes of earlier maps to those of later ones that see the same."""
    for n, node in enumerate(nodes):
        points = None
        for number in range(node.number):
            near = _nearest(nodes, placed, n, number)
            if near is None:
                continue
            if points is None:
                image = node.keyframe.image
                points = oriented_points(image, parts[node.number].sensor.max_depth).about(RULES.loop_points)
            older, ids = nodes[near], list(parts[number].keyframes)
            first = max(0, older.place - RULES.loop_neighbors)
            surface = parts[number].aligner.surface.of(ids[first : older.place + RULES.loop_neighbors + 1])
            T_other_first = older.keyframe.T_world_camera @ inverse(placed[near])
            guess, cells_m = T_other_first @ placed[n], RULES.loop_cells_m[0]
            step = loop((near, n), older.keyframe, surface, node.keyframe, points, [guess], cells_m)
            if step is not None:
                yield step


def _nearest(nodes: Sequence[_Node], placed: dict[int, Pose], n: int, number: int) -> int | None:
    """The keyframe of another map whose view is nearest to that of a keyframe, if they may see the same."""
    those = [k for k, other in enumerate(nodes) if other.number == number]
    apart = {k: tangent_norms(placed[n], placed[k]) for k in those}
    near = [k for k, (rad, m) in apart.items() if rad < RULES.view_rad and m < RULES.view_m]
    return min(near, key=lambda k: sum(apart[k]), default=None)


def _add(m: MRFMap, part: MRFMap, keyframe: Keyframe, T_world_camera: Pose, prefix: str) -> None:
    """Add a keyframe of one of the maps, with what that map knew of its noise."""
    own = keyframe.own
    if own.noise is None and part.config.sensor != m.config.sensor:
        own = replace(own, noise=part.noise)
    m.add_keyframe(
        keyframe.depth_m,
        T_world_camera,
        keyframe.camera,
        f"{prefix}{keyframe.name}",
        keyframe.stamp_s,
        keyframe.color if m.config.color else None,
        **own.arguments(),
    )
