"""Recordings of ROS 1 and 2, and MCAP files with a trial complete."""
