"""CloudFit: the normals of a whole cloud from one graph network."""
