"""ROS robots through rosbridge: JSON over a WebSocket."""
