"""The networks of the paper: a batch of patches in, one normal for each out."""
