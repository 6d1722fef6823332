"""Basler cameras through pylon. `frame_time` says how the time of a frame is known."""
