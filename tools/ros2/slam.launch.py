"""Starts the node: ros2 launch tools/ros2/slam.launch.py image:=/front/image_raw camera_info:=/front/camera_info

Every parameter of the node is an argument, such as base_frame:=base_link.
"""

import ast
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

NODE = Path(__file__).with_name("slam_node.py")
TOPICS = {"image": "image", "camera_info": "camera_info", "map": "map"}


def parameters() -> dict[str, float | str]:
    """Of the node, by name, with their defaults; read without importing it."""
    text = NODE.read_text(encoding="utf-8").partition("PARAMETERS: dict[str, Any] = ")[2]
    found: dict[str, float | str] = ast.literal_eval(text[: text.index("\n}") + 2])
    return found


def generate_launch_description() -> LaunchDescription:
    """The node in the Python of this shell."""
    defaults = parameters()
    arguments = [
        DeclareLaunchArgument(name, default_value=str(value))
        for name, value in (TOPICS | defaults).items()
    ]
    command: list[object] = ["python3", str(NODE), "--ros-args"]
    for name in TOPICS:
        command += ["-r", [name, ":=", LaunchConfiguration(name)]]
    for name, value in defaults.items():
        quote = "'" if isinstance(value, str) else ""  # an empty text is none without
        command += ["-p", [f"{name}:={quote}", LaunchConfiguration(name), quote]]
    return LaunchDescription([*arguments, ExecuteProcess(cmd=command, output="screen")])
