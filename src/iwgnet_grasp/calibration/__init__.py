"""Eye-to-hand calibration: targets, poses to show them in, samples, solution and report.

Frames: the board's origin is the middle of its print, x to the right, y up, z towards the reader.
"""
