"""A ROS 2 node for Nav2: images and their camera_info in; transforms, poses, points and an occupancy grid out.

Example: python tools/ros2/slam_node.py --ros-args -r image:=/front/image_raw -r camera_info:=/front/camera_info
"""

from array import array
from contextlib import suppress
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from live_map import USUAL_CAMERA_HEIGHT_M, LiveMap
from nav_msgs.msg import MapMetaData, OccupancyGrid, Path
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener

from erfsfm.common.errors import ErfsfmError, OneLineError
from slam import Slam
from slam.config.sections import load_config
from slam.formats.trajectory import write_tum
from slam.geometry.se3 import FloatArray, invert
from slam.runtime.errors import SlamError
from slam.sequences.bag import camera_file_of, image_of, is_rectified
from slam.sequences.camera_file import DEFAULT_FPS, Undistortion, undistorted

T_MAP_WORLD = np.array(
    [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
)  # without a base
STRIDE = 2  # pixels of the kept depth
PARAMETERS: dict[str, Any] = {
    "weights": "default",
    "settings": "",  # section.key=value, separated by spaces
    "camera_height_m": 0.0,  # above the road; 0: unknown
    "map_frame": "map",
    "odom_frame": "odom",
    "base_frame": "",  # of the robot, such as base_link; "": the frame of the images, which then has no parent
    "publish_tf": "both",  # map_to_odom where the robot has an odometry of its own; none
    "pose_every": 1,  # frames; here and below 0 is never
    "path_every": 10,
    "loops_every": 0,  # they are closed by the service close_loops, too
    "map_every": 50,  # a map is made after loops, too
    "resolution": 0.25,  # of the map
    "keyframe_spacing": 1.0,
    "depth_to": 10.0,
    "trajectory": "",  # TUM file written at the end
}


class SlamNode(Node):  # type: ignore[misc,unused-ignore]
    """Feeds ``slam.Slam``, from the first ``camera_info`` on.

    ``odom`` is continuous: each step is added to it as it is known then. What loops and later lengths change is in the
    transform from ``map`` to ``odom`` (REP 105).
    """

    def __init__(self) -> None:
        super().__init__("erfsfm_slam")
        any_type = ParameterDescriptor(dynamic_typing=True)  # 1 for 1.0
        self._of: dict[str, Any] = {
            name: type(v)(self.declare_parameter(name, v, any_type).value)
            for name, v in PARAMETERS.items()
        }
        self._slam: Slam | None = None
        self._undistortion: Undistortion | None = None
        self._map = LiveMap(
            self._of["resolution"], self._of["keyframe_spacing"], self._of["depth_to"]
        )
        self._T_base_camera: FloatArray | None = None
        self._T_odom_base: list[FloatArray] = []
        kept = QoSProfile(
            depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
        )  # for those who come later
        self._pose = self.create_publisher(PoseStamped, "pose", 10)
        self._path = self.create_publisher(Path, "path", 1)
        self._keyframe = self.create_publisher(PointCloud2, "keyframe_points", 10)
        self._points = self.create_publisher(PointCloud2, "map_points", kept)
        self._grid = self.create_publisher(OccupancyGrid, "map", kept)
        self._tf, self._known_tf = TransformBroadcaster(self), Buffer()
        self._listener = TransformListener(self._known_tf, self)
        newest = QoSProfile(
            depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT
        )  # others are dropped
        self.create_subscription(CameraInfo, "camera_info", self.begin, newest)
        self.create_subscription(Image, "image", self.add, newest)
        self.create_service(Trigger, "close_loops", self.close_loops)

    def begin(self, info: CameraInfo) -> None:
        """Take the calibration; of ``image_rect...`` that of the rectified camera."""
        if self._slam is None:
            rectified = is_rectified(self.resolve_topic_name("image"))
            try:
                camera = camera_file_of(info, rectified, DEFAULT_FPS, "camera_info")
                intrinsics, self._undistortion = undistorted(camera)
            except OneLineError as error:  # another message may be calibrated
                self.get_logger().error(str(error), once=True)
                return
            config = load_config(None, self._of["settings"].split())
            height_m = self._of["camera_height_m"] or None
            self._slam = Slam.from_weights(
                self._of["weights"], intrinsics, config, height_m, with_map=True
            )

    def add(self, message: Image) -> None:
        """Measure an image and say where it was taken; one that cannot be used is left out and logged."""
        if self._slam is None or not self._knows_base(message.header):
            lacking = (
                "camera_info"
                if self._slam is None
                else f"transform from {self._of['base_frame']} to the camera"
            )
            self._say(f"no {lacking} yet: images are left out")
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        try:
            image = image_of(message, f"the image at {stamp:.3f} s")
            self._slam.add_frame(
                self._undistortion.apply(image) if self._undistortion else image, stamp
            )
            self._publish(message.header)
            if self._is_due("loops_every"):
                self._solve()
        except (SlamError, ErfsfmError, ValueError) as error:
            self.get_logger().error(str(error))

    def close_loops(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """The service: solve the whole drive and publish its map. Images that come meanwhile are dropped."""
        try:
            response.success, response.message = True, f"{self._solve()} loops"
        except SlamError as error:
            response.success, response.message = False, str(error)
        return response

    def finish(self) -> None:
        """Close the loops and write the trajectory; its world is the first camera."""
        if self._slam is not None and len(self._slam):
            with self._slam as slam:
                slam.close_loops()
                if self._of["trajectory"]:
                    write_tum(self._of["trajectory"], slam.trajectory())

    def _say(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _is_due(self, name: str) -> bool:
        """Whether it is the turn of what comes every so many frames; 0 is never."""
        return bool(self._of[name]) and len(self._slam or ()) % self._of[name] == 0

    def _knows_base(self, image: Header) -> bool:
        """Find once where the camera is on the robot."""
        if self._T_base_camera is None and not self._of["base_frame"]:
            self._T_base_camera = np.eye(4)
        if self._T_base_camera is None:
            with suppress(TransformException):
                found = self._known_tf.lookup_transform(
                    self._of["base_frame"], image.frame_id, Time()
                )
                self._T_base_camera = matrix_of(found.transform)
        return self._T_base_camera is not None

    def _T_map_camera(self) -> FloatArray:
        """Of all frames ``(N, 4, 4)``: the map begins at the robot's base, or else at the camera with x ahead."""
        assert self._slam is not None and self._T_base_camera is not None
        T_map_world = self._T_base_camera if self._of["base_frame"] else T_MAP_WORLD
        T_map_camera: FloatArray = T_map_world @ self._slam.trajectory().T_world_camera
        return T_map_camera

    def _solve(self) -> int:
        """Close loops, and take all keyframes at the new poses and lengths; the number of loops."""
        if self._slam is None:
            raise SlamError("no camera_info yet")
        loops = self._slam.close_loops()
        self._map.clouds.clear()
        self._map.add(self._slam.clouds(stride=STRIDE), self._T_map_camera())
        self._publish_map()
        return len(loops.accepted)

    def _publish(self, image: Header) -> None:
        """Everything that a new image changes."""
        assert self._slam is not None and self._T_base_camera is not None
        T_map_camera, count = self._T_map_camera(), len(self._slam)
        header = Header(stamp=image.stamp, frame_id=self._of["map_frame"])
        self._publish_tf(T_map_camera @ invert(self._T_base_camera), header, image.frame_id)
        if self._is_due("pose_every"):
            self._pose.publish(PoseStamped(header=header, pose=pose_of(T_map_camera[-1])))
        if self._is_due("path_every"):
            stamps = (
                Time(nanoseconds=round(1e9 * stamp)).to_msg()
                for stamp in self._slam.trajectory().stamps
            )
            headers = [Header(stamp=stamp, frame_id=header.frame_id) for stamp in stamps]
            poses = [PoseStamped(header=h, pose=pose_of(T)) for h, T in zip(headers, T_map_camera)]
            self._path.publish(Path(header=header, poses=poses))
        if self._slam.unit_name is not None:
            for frame in self._map.add(self._slam.clouds(count - 1, STRIDE), T_map_camera):
                self._keyframe.publish(points_of(self._map.clouds[frame], image))
            if self._is_due("map_every"):
                self._publish_map()

    def _publish_tf(self, T_map_base: FloatArray, header: Header, camera: str) -> None:
        """The robot in ``odom``, and ``odom`` in the map, at the newest of the poses ``(N, 4, 4)``."""
        newest = len(T_map_base) - 1
        if self._of["publish_tf"] == "none":
            return
        base = self._of["base_frame"] or camera
        if self._of["publish_tf"] == "map_to_odom":
            try:
                found = self._known_tf.lookup_transform(
                    self._of["odom_frame"], base, Time.from_msg(header.stamp)
                )
            except TransformException as error:
                self._say(f"no {self._of['odom_frame']} at the time of the image: {error}")
                return
            T_odom_base = matrix_of(found.transform)
        else:
            while (
                len(self._T_odom_base) <= newest
            ):  # images without a pose of their own are bridged later
                k = len(self._T_odom_base)
                step = invert(T_map_base[k - 1]) @ T_map_base[k] if k else T_map_base[0]
                self._T_odom_base.append(self._T_odom_base[-1] @ step if k else step)
            T_odom_base = self._T_odom_base[-1]
            odom = Header(stamp=header.stamp, frame_id=self._of["odom_frame"])
            self._tf.sendTransform(transform_of(T_odom_base, odom, base))
        T_map_odom = T_map_base[newest] @ invert(T_odom_base)
        self._tf.sendTransform(transform_of(T_map_odom, header, self._of["odom_frame"]))

    def _publish_map(self) -> None:
        """Points and grid of all keyframes."""
        assert self._slam is not None
        if not self._map.clouds:
            return
        T_map_camera = self._T_map_camera()
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._of["map_frame"])
        self._points.publish(points_of(self._map.points(T_map_camera), header))
        height_m = self._of["camera_height_m"]
        metre = 1.0 if self._slam.unit_name == "m" else 1.0 / USUAL_CAMERA_HEIGHT_M
        try:
            cells, grid = self._map.grid(
                T_map_camera, metre * (height_m or USUAL_CAMERA_HEIGHT_M), metre
            )
        except SlamError as error:
            self._say(str(error))
            return
        T_map_corner = np.eye(4)
        T_map_corner[:2, 3] = grid.corner
        size = {"resolution": grid.resolution, "width": grid.width, "height": grid.height}
        info = MapMetaData(map_load_time=header.stamp, origin=pose_of(T_map_corner), **size)
        self._grid.publish(
            OccupancyGrid(header=header, info=info, data=array("b", cells.tobytes()))
        )


def pose_of(T: FloatArray) -> Pose:
    """The message of a pose."""
    xyzw = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    return Pose(
        position=Point(**dict(zip("xyz", T[:3, 3].tolist()))),
        orientation=Quaternion(**dict(zip("xyzw", xyzw))),
    )


def transform_of(T: FloatArray, header: Header, child: str) -> TransformStamped:
    """The message of a transform, of ``child`` in the frame of the header."""
    pose = pose_of(T)
    at = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    transform = Transform(translation=at, rotation=pose.orientation)
    return TransformStamped(header=header, child_frame_id=child, transform=transform)


def matrix_of(transform: Transform) -> FloatArray:
    """``(4, 4)`` of a message."""
    t, q = transform.translation, transform.rotation
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), (t.x, t.y, t.z)
    return T


def points_of(points: FloatArray, header: Header) -> PointCloud2:
    """The message of points ``(P, 3)``."""
    fields = [
        PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
        for k, name in enumerate("xyz")
    ]
    data = array("B", points.astype(np.float32).tobytes())
    size = {"height": 1, "width": len(points), "point_step": 12, "row_step": 12 * len(points)}
    return PointCloud2(
        header=header, fields=fields, is_bigendian=False, is_dense=True, data=data, **size
    )


if __name__ == "__main__":
    rclpy.init()
    node, executor = (
        SlamNode(),
        MultiThreadedExecutor(2),
    )  # transforms arrive while an image is measured
    executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    node.finish()
