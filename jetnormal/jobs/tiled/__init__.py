"""Clouds larger than memory: cut into tiles on disk, each of which goes the way of a cloud that fits.

partition -> directions of each tile -> a thinned cloud with signs -> signs of each tile -> the output, in its order
"""
