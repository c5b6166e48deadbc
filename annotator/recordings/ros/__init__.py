"""ROS 1 and ROS 2 bags, MCAP files and RealSense's own bags, read without ROS.

What is damaged raises ValueError in here; the recording turns it into the error of a frame.
"""
