"""Geometry on plain arrays: arrays in, arrays out; no files, no networks."""
