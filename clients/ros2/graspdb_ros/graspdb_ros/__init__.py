"""GraspDB in ROS 2, as an example."""
