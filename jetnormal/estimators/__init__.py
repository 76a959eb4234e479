"""Points in, unoriented normals out: by patches or for the whole cloud at once."""
