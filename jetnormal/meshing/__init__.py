"""Meshes from oriented normals: Poisson reconstruction and what is cut away after it."""
