"""ROS 2 through rosbridge, without ROS on the host of petrobot (docs/robots/ros2.md)."""
