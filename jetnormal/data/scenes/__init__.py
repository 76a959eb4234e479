"""Procedural scenes: rooms, streets and terrain as meshes with exact normals."""
