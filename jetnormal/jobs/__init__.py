"""Whole jobs, from files to files: estimate, reconstruct, preview."""
