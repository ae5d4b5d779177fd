"""An example of each public name, in the order of the API page, which shows each section below its name.

The program runs from top to bottom (tests/docs/test_api_examples.py). A line ``# tm.NAME`` opens the section
of that name, or of several.
"""

from pathlib import Path

import numpy as np

import taichi_mrf as tm

# tm.init
print(tm.init("cpu"))  # "auto", the default, takes CUDA, else Vulkan, else the CPU

# tm.MRFMap
m = tm.MRFMap(voxel_size=0.1)
for frame in tm.open_dataset("synthetic:room?frames=6&width=80&height=60"):
    m.add(frame)
m.infer()
print(m.occupancy([[0.0, 0.0, 1.0]]), m.state([[0.0, 0.0, 1.0]]))

# tm.LogOddsMap
octomap = tm.LogOddsMap(voxel_size=0.1, max_range=5.0)
octomap.add(frame)

# tm.VisibilityMap
visibility = tm.VisibilityMap(voxel_size=0.1)
visibility.add(frame)

# tm.WavemapMap
wavemap = tm.WavemapMap(voxel_size=0.1)
wavemap.add(frame)

# tm.PinholeCamera
camera = tm.PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
wall_m = np.full(camera.shape, 2.0, np.float32)  # axial depth; 0 or NaN where there is no measurement
wall = tm.MRFMap(voxel_size=0.1)
wall.add_keyframe(wall_m, np.eye(4), camera)

# tm.DistortedCamera
wide = tm.DistortedCamera(camera, (-0.1, 0.02, 0.0, 0.0))  # k1, k2, p1, p2 of OpenCV

# tm.SphericalCamera
rows, columns = np.radians(np.linspace(15, -15, 16)), np.radians(np.arange(0, 360, 2))
lidar = tm.SphericalCamera(rows, columns)  # 16 beams from top to bottom
wall.add_keyframe(np.full(lidar.shape, 1.5, np.float32), np.eye(4), lidar)  # ranges

# tm.RayTable
rays = tm.RayTable(lidar.rays())  # any rays, one by one

# tm.PolynomialNoise
kinect = tm.PolynomialNoise(sigma=(0.0015, -0.0015, 0.0019))  # metres, by powers of depth
precise = tm.MRFMap(voxel_size=0.05, noise=kinect)

# tm.PatchNoise
sigma, bias = np.zeros((2, 4, 5))  # of 2 x 2 patches of 40 pixels, row by row, five powers of depth
sigma[:, 2] = [0.002, 0.002, 0.003, 0.003]
learnt = tm.PatchNoise(sigma, bias, patch=40, camera=camera)

# tm.sigma_of_confidence
confidence = np.full(camera.shape, 0.5)
sigma_m = tm.sigma_of_confidence(confidence, wall_m, kinect, camera)

# tm.Frame
seen = tm.Frame(wall_m, np.eye(4), camera, stamp=12.5, name="wall", sigma_m=sigma_m)
id = wall.add(seen)
wall.renew([id])

# tm.UNKNOWN, tm.FREE, tm.OCCUPIED
states = m.state([[0.0, 0.0, 1.0], [0.0, 0.0, 90.0]])
print(states == tm.FREE, states == tm.UNKNOWN, states == tm.OCCUPIED)

# tm.read_box
around = tm.read_box(m, (-1, -1, 0), (1, 1, 2))
print(around.occupancy.shape, (around.state == tm.OCCUPIED).sum())

# tm.slice_map
level = tm.slice_map(m, at=1.0)
print(level.occupancy.shape, level.extent)  # as imshow takes them

# tm.cast_rays
hits = tm.cast_rays(m, np.zeros((1, 3)), [[0.0, 0.0, 1.0]], max_range=5.0)
print(hits.hit, hits.range)

# tm.DistanceField
field = tm.DistanceField(m, max_distance_m=1.0)
print(field.distance([[0.0, 0.0, 1.0]]))  # to the nearest obstacle

# tm.find_frontiers
frontiers = tm.find_frontiers(m, min_voxels=5)
print(len(frontiers.sizes), "borders between free and unknown space")

# tm.view_gain
print(tm.view_gain(m, camera, np.eye(4), max_depth=5.0), "bits would a view from there tell")

# tm.compare_maps
change = tm.compare_maps(octomap, m)
print(change.counts, "voxels by their state before and after")

# tm.live
with tm.live(wall) as page:  # http://127.0.0.1:8080
    wall.renew([wall.add(seen)])
    page.update()

# tm.publish
with tm.publish(wall, port=0) as served:  # ws://127.0.0.1:8765 unless told
    wall.renew([wall.add_keyframe(wall_m, np.eye(4), camera)])
    served.update()

# tm.show
tm.show(m, browser=False)  # until Ctrl-C; in a notebook, below the cell

# tm.locate
tuesday = tm.open_dataset("synthetic:room?frames=8&width=80&height=60&seed=2")  # in whatever world
located = tm.locate(m, tuesday)
print(located.T_map_recording, f"{100 * located.sigma_m:.0f} cm", located.reason)

# tm.merge
other = tm.MRFMap(voxel_size=0.1)
for frame in tuesday:
    other.add(frame)
other.infer()
both = tm.merge([m, other])
print(len(both.map.keyframes), "keyframes,", both.loops, "steps measured between the maps")

# tm.open_dataset
for frame in tm.open_dataset("synthetic:room?frames=2&width=80&height=60"):
    print(frame.name, frame.depth_m.shape, frame.T_world_camera[:3, 3])

# tm.load_map
m.save("map.npz")
again = tm.load_map("map.npz")

# tm.export_map, tm.ExportOptions
tm.export_map(m, "mesh.ply", tm.ExportOptions(mesh=True))
tm.export_map(m, "map.zarr")

# tm.ChunkedMap
store = tm.ChunkedMap.open("map.zarr")  # answers from disk, however large

# tm.take_part
part = tm.take_part(store, (-1, -1, -1), (1, 1, 1))

# tm.accuracy
score = tm.accuracy(m, frame.depth_m, frame.T_world_camera, frame.camera)
print(f"{score.score:.0%} of the pixels meet the right voxel")

# tm.Config
config = tm.Config(voxel_size=0.02, sensor=tm.Config().sensor)

# tm.TaichiMRFError
try:
    tm.load_map(Path("nowhere.npz"))
except tm.TaichiMRFError as error:
    print(error)  # one line that says what to do
