"""Networks: a batch of patches in, a prediction out."""
