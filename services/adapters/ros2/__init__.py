"""ROS 2 through rosbridge, without ROS on this side (docs/robots/ros2.md)."""
