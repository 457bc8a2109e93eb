"""A ROS 2 node: images and their camera_info in; pose, path and transform of the camera out.

Example: python tools/ros2/slam_node.py --ros-args -r image:=/front/image_raw -r camera_info:=/front/camera_info
"""

from contextlib import suppress

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from tf2_ros import TransformBroadcaster

from erfsfm.common.errors import ErfsfmError
from slam import Slam
from slam.config.sections import load_config
from slam.formats.trajectory import Trajectory, write_tum
from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SlamError
from slam.sequences.camera_file import DEFAULT_FPS
from slam.sequences.ros.messages import camera_file_of, image_of
from slam.sequences.undistortion import Undistortion

T_MAP_WORLD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
PARAMETERS = {
    "weights": "default",
    "settings": "",  # section.key=value, separated by spaces
    "camera_height_m": 0.0,  # above the road; 0: unknown
    "map_frame": "map",
    "pose_every": 1,  # frames
    "path_every": 10,  # frames
    "publish_tf": True,  # False where the camera's frame has a parent already
    "trajectory": "",  # TUM file written at the end
}


class SlamNode(Node):  # type: ignore[misc,unused-ignore]
    """Feeds ``slam.Slam``, from the first ``camera_info`` on."""

    def __init__(self) -> None:
        super().__init__("erfsfm_slam")
        self._of = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self._slam: Slam | None = None
        self._undistortion: Undistortion | None = None
        self._pose = self.create_publisher(PoseStamped, "pose", 10)
        self._path = self.create_publisher(Path, "path", 1)
        self._tf = TransformBroadcaster(self) if self._of["publish_tf"] else None
        newest = QoSProfile(depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)  # others are dropped
        self.create_subscription(CameraInfo, "camera_info", self.begin, newest)
        self.create_subscription(Image, "image", self.add, newest)

    def begin(self, info: CameraInfo) -> None:
        """Take the calibration; of ``image_rect...`` that of the rectified camera."""
        if self._slam is None:
            is_rectified = self.resolve_topic_name("image").rpartition("/")[2].startswith("image_rect")
            camera = camera_file_of(info, is_rectified, DEFAULT_FPS, "camera_info")
            self._undistortion = None if camera.model == "pinhole" else Undistortion(camera)
            intrinsics = self._undistortion.intrinsics if self._undistortion else Intrinsics.of(camera.pinhole)
            config, height_m = load_config(None, self._of["settings"].split()), self._of["camera_height_m"] or None
            self._slam = Slam.from_weights(self._of["weights"], intrinsics, config, height_m)

    def add(self, message: Image) -> None:
        """Measure an image and say where it was taken; one that cannot be used is left out and logged."""
        if self._slam is None:
            self.get_logger().warning("no camera_info yet: images are left out", throttle_duration_sec=5.0)
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        try:
            image = image_of(message, f"the image at {stamp:.3f} s")
            self._slam.add_frame(self._undistortion.apply(image) if self._undistortion else image, stamp)
            if len(self._slam) % self._of["pose_every"] == 0:
                self._publish(self._slam.trajectory(), message.header)
        except (SlamError, ErfsfmError, ValueError) as error:
            self.get_logger().error(str(error))

    def finish(self) -> None:
        """Close the loops and write the trajectory; its world is the first camera."""
        if self._slam is not None and len(self._slam):
            with self._slam as slam:
                slam.close_loops()
                if self._of["trajectory"]:
                    write_tum(self._of["trajectory"], slam.trajectory())

    def _publish(self, trajectory: Trajectory, image: Header) -> None:
        header = Header(stamp=image.stamp, frame_id=self._of["map_frame"])
        newest = pose_of(T_MAP_WORLD @ trajectory.T_world_camera[-1])
        self._pose.publish(PoseStamped(header=header, pose=newest))
        if self._tf is not None:
            at = Vector3(x=newest.position.x, y=newest.position.y, z=newest.position.z)
            transform = Transform(translation=at, rotation=newest.orientation)
            self._tf.sendTransform(TransformStamped(header=header, child_frame_id=image.frame_id, transform=transform))
        if len(trajectory) % self._of["path_every"] == 0:
            stamps = (Time(nanoseconds=round(1e9 * stamp)).to_msg() for stamp in trajectory.stamps)
            headers = [Header(stamp=stamp, frame_id=header.frame_id) for stamp in stamps]
            poses = [
                PoseStamped(header=h, pose=pose_of(T)) for h, T in zip(headers, T_MAP_WORLD @ trajectory.T_world_camera)
            ]
            self._path.publish(Path(header=header, poses=poses))


def pose_of(T_map_camera: FloatArray) -> Pose:
    """The message of a pose in the map, whose origin is the first camera: x ahead, y left, z up."""
    rotation, position = Rotation.from_matrix(T_map_camera[:3, :3]), T_map_camera[:3, 3].tolist()
    xyzw = rotation.as_quat(canonical=True).tolist()
    return Pose(position=Point(**dict(zip("xyz", position))), orientation=Quaternion(**dict(zip("xyzw", xyzw))))


if __name__ == "__main__":
    rclpy.init()
    node = SlamNode()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    node.finish()
