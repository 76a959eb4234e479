"""Geometry on plain arrays: neighbors, patches, jets, pyramids, error measures. It knows no files and no networks."""
