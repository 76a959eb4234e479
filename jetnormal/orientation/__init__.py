"""The signs of normals: which of its two directions each normal takes."""
