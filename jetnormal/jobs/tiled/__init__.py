"""Clouds larger than memory: they are cut into tiles on disk, and each tile is computed as a cloud in memory is.

tiles -> directions of each tile -> signs of a thinned cloud -> signs of each tile -> the output, in the input's order
"""
