"""ROS 1 and ROS 2 bags through rosbags, an optional extra."""
