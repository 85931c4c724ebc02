"""A ROS robot behind rosbridge: JSON over a WebSocket."""
