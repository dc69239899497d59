"""Grasp data: depth, rectangles, labels, and the sets on disk."""
