"""Map the depth images of a ROS 2 robot in a node of your own, and watch the map at http://127.0.0.1:8080.

    python3 examples/ros_node.py --ros-args -r depth:=/depth/image_raw -r info:=/depth/camera_info

It needs rclpy, and was not run with it: the tests run it with stand-ins of the ROS modules.
"""

from typing import Any

import numpy as np
import rclpy
import tf2_ros
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

import taichi_mrf as tm
from taichi_mrf.datasets.ros import messages


class Mapper(Node):
    def __init__(self, m: tm.MRFMap, page: Any) -> None:
        super().__init__("taichi_mrf")
        self.map, self.page, self.camera, self.last = m, page, None, np.zeros((4, 4))
        self.tf = tf2_ros.Buffer()  # heard in a thread of its own, while callbacks wait for it
        self.listener = tf2_ros.TransformListener(self.tf, rclpy.create_node("tf_of_map"), spin_thread=True)
        self.create_subscription(CameraInfo, "info", self.on_info, 1)
        self.create_subscription(Image, "depth", self.on_depth, qos_profile_sensor_data)

    def on_info(self, info: Any) -> None:
        self.camera = tm.PinholeCamera(info.width, info.height, info.k[0], info.k[4], info.k[2], info.k[5])

    def on_depth(self, image: Any) -> None:
        frame, stamp, wait = image.header.frame_id, Time.from_msg(image.header.stamp), Duration(seconds=0.1)
        try:
            T_world_camera = messages.pose_of(self.tf.lookup_transform("odom", frame, stamp, wait))
        except tf2_ros.TransformException as error:
            return self.get_logger().warning(f"no pose: {error}")
        if self.camera is None or np.abs(T_world_camera - self.last).max() < 0.05:
            return  # it stands still
        self.last, seconds = T_world_camera, 1e-9 * messages.header_ns(image.header)
        depth_m = messages.depth_image(image, depth_scale=None)
        key = self.map.add_keyframe(depth_m, T_world_camera, self.camera, stamp_s=seconds)
        self.map.renew([key], seconds=0.2)
        self.page.update()


def main() -> None:
    rclpy.init()
    tm.init()
    m = tm.MRFMap(voxel_size=0.05)
    with tm.live(m) as page:
        try:
            rclpy.spin(Mapper(m, page))
        except KeyboardInterrupt:
            m.infer()
            m.save("map.npz")


if __name__ == "__main__":
    main()
