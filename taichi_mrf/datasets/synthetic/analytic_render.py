"""Pictures of an analytic scene: one ray through each pixel's centre, on Taichi."""

import numpy as np
from numpy.typing import NDArray

from taichi_mrf.datasets.synthetic.analytic_scene import KINDS, Scene
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.camera import Camera, PinholeCamera
from taichi_mrf.sensor.origins import origins_of
from taichi_mrf.system.compiler import ti
from taichi_mrf.system.types import F32, I32, AnyArray, Mat3, Template, Vec3, Vec4

BOX, SPHERE = KINDS.index("box"), KINDS.index("sphere")
NOTHING = 1e30
"""The ray parameter of a ray that meets no solid."""


def render(
    scene: Scene, camera: PinholeCamera, T_world_camera: Pose, color: bool = True
) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Axial depth, (H, W) float32 in metres, 0 where a ray meets nothing, and a shaded picture, (H, W, 3)
    uint8 RGB, or None without ``color``. Taichi has to run, and the camera to be outside of all solids."""
    depth_m = np.zeros(camera.shape, dtype=np.float32)
    shaded = np.zeros((*camera.shape, 3) if color else (1, 1, 3), dtype=np.float32)
    # A colour picture needs all solids: those that are not in the picture throw shadows into it.
    kept = slice(None) if color else _may_be_seen(scene.geometry, camera, T_world_camera)
    _cast(
        scene.geometry[kept],
        scene.materials[kept],
        ti.Matrix(T_world_camera[:3, :3].tolist()),
        ti.Vector(T_world_camera[:3, 3].tolist()),
        ti.Vector([camera.fx, camera.fy, camera.cx, camera.cy]),
        ti.Vector(list(scene.light)),
        int(color),
        depth_m,
        shaded,
    )
    return depth_m, np.clip(np.round(255 * shaded), 0, 255).astype(np.uint8) if color else None


def ray_depths(scene: Scene, camera: Camera, T_world_camera: Pose) -> NDArray[np.float32]:
    """Depth along the rays of any camera, (H, W) float32 in metres (range for a lidar), 0 where a ray meets
    nothing. As for :func:`render`, Taichi has to run, and the camera to be outside of all solids."""
    directions = camera.rays().reshape(-1, 3) @ T_world_camera[:3, :3].T
    depth_m = np.zeros(len(directions), dtype=np.float32)
    origins = origins_of(camera)
    starts = np.zeros((1, 3)) if origins is None else np.broadcast_to(origins, (*camera.shape, 3))
    eyes = starts.reshape(-1, 3) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    _cast_rays(scene.geometry, directions.astype(np.float32), eyes.astype(np.float32), depth_m)
    return depth_m.reshape(camera.shape)


def _may_be_seen(
    geometry: NDArray[np.float32], camera: PinholeCamera, T_world_camera: Pose
) -> NDArray[np.int64]:
    """The solids whose bounding balls meet the cone around the image; at least one."""
    widest = float(np.arccos(1.0 / camera.largest_slant()))
    to_center = geometry[:, 1:4] - T_world_camera[:3, 3]
    distance = np.linalg.norm(to_center, axis=1)
    radius = np.sqrt(geometry[:, 9])
    outside = distance > radius
    sine = np.where(outside, radius / np.maximum(distance, 1e-9), 1.0)
    cosine = to_center @ T_world_camera[:3, 2] / np.maximum(distance, 1e-9)
    near = np.arccos(np.clip(cosine, -1, 1)) <= widest + np.arcsin(sine) + 1e-3
    kept = np.flatnonzero(near | ~outside)
    return kept if len(kept) else np.zeros(1, np.int64)


@ti.func
def _slab(origin: F32, direction: F32, half: F32):
    """Ray parameters where a ray enters and leaves |x| <= half."""
    # A parallel ray's bounds become huge and keep the right signs.
    inverse = 1.0 / ti.select(ti.abs(direction) < 1e-9, 1e-9, direction)
    middle, reach = -origin * inverse, half * ti.abs(inverse)
    return ti.Vector([middle - reach, middle + reach])


@ti.func
def _round_slab(origin: Template, direction: Template, radius: F32):
    """Ray parameters where a ray enters and leaves |x| <= radius: a circle in 2 dimensions, a ball in 3."""
    a = ti.max(direction.dot(direction), 1e-18)
    closest = -origin.dot(direction) / a
    # From the closest point and not as b^2 - 4ac, which loses the digits of a small far solid.
    gap = origin + closest * direction
    half_chord_squared = (radius * radius - gap.dot(gap)) / a
    out = ti.Vector([NOTHING, -NOTHING])
    if half_chord_squared >= 0:
        half_chord = ti.sqrt(half_chord_squared)
        out = ti.Vector([closest - half_chord, closest + half_chord])
    return out


@ti.func
def _to_local(geometry: Template, i: I32, vector: Template):
    """A world direction in the axes of solid i."""
    c, s = geometry[i, 7], geometry[i, 8]
    return ti.Vector([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0], vector[2]])


@ti.func
def _entry(geometry: Template, i: I32, origin: Template, direction: Template):
    """Ray parameter where a ray from outside enters solid i, or NOTHING."""
    center = ti.Vector([geometry[i, 1], geometry[i, 2], geometry[i, 3]])
    o, d = _to_local(geometry, i, origin - center), _to_local(geometry, i, direction)
    span = ti.Vector([0.0, 0.0])
    if geometry[i, 0] == SPHERE:
        span = _round_slab(o, d, geometry[i, 4])
    else:
        z = _slab(o[2], d[2], geometry[i, 6])
        if geometry[i, 0] == BOX:
            x, y = _slab(o[0], d[0], geometry[i, 4]), _slab(o[1], d[1], geometry[i, 5])
            span = ti.Vector([ti.max(x[0], y[0], z[0]), ti.min(x[1], y[1], z[1])])
        else:
            side = _round_slab(ti.Vector([o[0], o[1]]), ti.Vector([d[0], d[1]]), geometry[i, 4])
            span = ti.Vector([ti.max(side[0], z[0]), ti.min(side[1], z[1])])
    t = NOTHING
    if span[0] <= span[1] and span[0] > 0:
        t = span[0]
    return t


@ti.func
def _nearest(geometry: Template, origin: Template, direction: Template):
    """The first solid that a ray enters: (ray parameter, its index)."""
    nearest, index = NOTHING, -1
    per_square = 1.0 / direction.dot(direction)
    for i in range(geometry.shape[0]):
        to_center = ti.Vector([geometry[i, 1], geometry[i, 2], geometry[i, 3]]) - origin
        gap = to_center - to_center.dot(direction) * per_square * direction
        # A ray passes most solids at a distance: testing their bounding balls first is three times as fast.
        if gap.dot(gap) <= geometry[i, 9]:
            t = _entry(geometry, i, origin, direction)
            if t < nearest:
                nearest, index = t, i
    return nearest, index


@ti.func
def _normal(geometry: Template, i: I32, point: Template):
    """Outward unit normal of solid i at a point of its surface."""
    center = ti.Vector([geometry[i, 1], geometry[i, 2], geometry[i, 3]])
    p = _to_local(geometry, i, point - center)
    local = p
    if geometry[i, 0] != SPHERE:
        # The surface is that of the bounds which the point has gone furthest towards.
        beyond = ti.abs(p) - ti.Vector([geometry[i, 4], geometry[i, 5], geometry[i, 6]])
        flat = ti.Vector([p[0], p[1], 0.0])
        if geometry[i, 0] == BOX:
            flat = ti.Vector([ti.math.sign(p[0]), 0.0, 0.0])
            if beyond[1] > beyond[0]:
                flat = ti.Vector([0.0, ti.math.sign(p[1]), 0.0])
            beyond[0] = ti.max(beyond[0], beyond[1])
        else:
            beyond[0] = ti.sqrt(p[0] * p[0] + p[1] * p[1]) - geometry[i, 4]
        local = flat
        if beyond[2] > beyond[0]:
            local = ti.Vector([0.0, 0.0, ti.math.sign(p[2])])
    local = local.normalized()
    c, s = geometry[i, 7], geometry[i, 8]
    return ti.Vector([c * local[0] - s * local[1], s * local[0] + c * local[1], local[2]])


@ti.func
def _paint(materials: Template, i: I32, point: Template, normal: Template):
    """RGB of the solid's paint at a point: plain, or darker on every second square."""
    paint = ti.Vector([materials[i, 0], materials[i, 1], materials[i, 2]])
    edge = materials[i, 3]
    if edge > 0:
        parity = 0
        for axis in ti.static(range(3)):
            if ti.abs(normal[axis]) < 0.5:  # along the normal rounding would decide the square
                parity += int(ti.floor(point[axis] / edge))
        if parity % 2 != 0:
            paint *= 0.72
    return paint


@ti.func
def _brightness(geometry: Template, point: Template, normal: Template, direction: Template, light: Template):
    """Share of the paint's colour that is seen: some always, more facing the camera and out of the shadow."""
    to_light = light - point
    lit = ti.max(normal.dot(to_light.normalized()), 0.0)
    start = point + 1e-3 * normal  # off the surface, or it would shade itself
    blocked, _ = _nearest(geometry, start, light - start)
    if blocked < 1.0:
        lit = 0.0
    return 0.32 + 0.23 * ti.abs(normal.dot(direction.normalized())) + 0.55 * lit


@ti.kernel
def _cast(
    geometry: AnyArray,  # (solids, 10), as Scene.geometry
    materials: AnyArray,  # (solids, 4), as Scene.materials
    R_world_camera: Mat3,
    camera_in_world: Vec3,
    intrinsics: Vec4,  # fx, fy, cx, cy
    light: Vec3,
    color: I32,
    depth_m: AnyArray,  # (H, W)
    shaded: AnyArray,  # (H, W, 3), or anything without color
):
    for row, column in depth_m:
        x = (ti.cast(column, ti.f32) - intrinsics[2]) / intrinsics[0]
        y = (ti.cast(row, ti.f32) - intrinsics[3]) / intrinsics[1]
        # Not normalised: with z = 1 in the camera's frame the ray's parameter is axial depth.
        direction = R_world_camera @ ti.Vector([x, y, 1.0])
        t, i = _nearest(geometry, camera_in_world, direction)
        # Every pixel is written: what a kernel leaves out of an array that it does not read is not zero
        # on every backend.
        depth_m[row, column] = ti.select(i >= 0, t, 0.0)
        if color != 0:
            paint = ti.Vector([0.0, 0.0, 0.0])
            if i >= 0:
                point = camera_in_world + t * direction
                normal = _normal(geometry, i, point)
                brightness = _brightness(geometry, point, normal, direction, light)
                paint = brightness * _paint(materials, i, point, normal)
            for channel in ti.static(range(3)):
                shaded[row, column, channel] = paint[channel]


@ti.kernel
def _cast_rays(
    geometry: AnyArray,  # (solids, 10), as Scene.geometry
    directions: AnyArray,  # (N, 3) in the world
    eyes: AnyArray,  # (N, 3) in the world, or (1, 3) for all
    depth_m: AnyArray,  # (N,)
):
    for ray in depth_m:
        direction = ti.Vector([directions[ray, 0], directions[ray, 1], directions[ray, 2]])
        at = ti.min(ray, eyes.shape[0] - 1)
        eye = ti.Vector([eyes[at, 0], eyes[at, 1], eyes[at, 2]])
        t, i = _nearest(geometry, eye, direction)
        depth_m[ray] = ti.select(i >= 0, t, 0.0)
