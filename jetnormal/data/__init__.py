"""Clouds to learn from and to measure on: data sources, sampling, corruption, benchmark folders."""
