"""Poses: a keyframe is moved to where its depth fits the others', a recording is found in an earlier map.

A depth image becomes points with normals (oriented_points), keyframes the surface that they have measured
(surfels, surfel_grid). Point-to-plane distances between them are summed up on the device (point_to_plane),
levenberg takes the steps, and refine decides whether to move at all. A frame whose camera is tracked (locate)
is aligned with the contrast of keyframes too (contrast, photometric, keyframe_pictures). joint moves all
keyframes at once; poses count as recorded (recorded), and small steps are twists (se3). pairs measures the
step from one keyframe to another, and pose_graph finds the poses that such steps agree with (pose_equations);
appearance tells which keyframes may have seen the same. locate_recording finds a recording (scan) in a map
(whole_map) without a guess: wide_search proposes poses, and seen_through gives away those that fit by chance;
locate_around does so for one scan. All thresholds are in rules.
"""
