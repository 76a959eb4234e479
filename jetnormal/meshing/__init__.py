"""Meshes from oriented normals: Poisson reconstruction, and the cleaning after it."""
