"""Poses that are slightly wrong: moving a keyframe to where its depth fits the map of all others.

A depth image becomes points with normals (oriented_points), those of the other keyframes the surface that
they have measured, voxel by voxel (surfels, surfel_grid). Point-to-plane distances to it are summed up on the
device (point_to_plane), levenberg takes the steps, and refine decides whether to move at all, after asking
the map how likely the depth is (likelihood). A frame whose camera is tracked (locate) is aligned with the
contrast of keyframes too (contrast, photometric, keyframe_pictures). joint moves all keyframes at once. Poses
count as recorded with some error, or steps as tracked (recorded), and small steps of them are twists (se3).

pairs measures the step from one keyframe to another, and pose_graph finds the poses that such steps agree
with; it solves sparse equations as joint does (pose_equations). appearance and shared_views tell which
keyframes may have seen the same.
"""
