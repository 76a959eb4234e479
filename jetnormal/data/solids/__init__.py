"""Procedural solids with exact normals."""
