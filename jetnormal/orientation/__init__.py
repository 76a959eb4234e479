"""The signs of normals: which side of the surface each one shows."""
