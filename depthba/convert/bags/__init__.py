"""Recordings of ROS 1, ROS 2 and MCAP: messages, tf trees, depth images."""
