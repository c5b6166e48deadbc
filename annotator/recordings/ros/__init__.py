"""ROS 1 and ROS 2 bags, MCAP files and RealSense's own bags, read without ROS."""
