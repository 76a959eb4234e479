"""Compiled loops over points and edges. They run in one thread, so that results do not depend on the threads.

Arrays are C-contiguous: float64 unless said otherwise, indices int64; the edges of N points to k neighbors are float32,
and the neighbors int32.
"""
