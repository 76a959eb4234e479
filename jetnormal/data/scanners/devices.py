"""The errors of ranging devices, with parameters drawn at random.

At `distance` the errors of a device have the size `sigma`; both are multiples of the size of the target.
"""

from __future__ import annotations

import numpy as np

from jetnormal.data.scanners.range_errors import RangeErrors
from jetnormal.data.scanners.scan import log_uniform


def stripe_errors(rng: np.random.Generator, distance: float, sigma: float) -> RangeErrors:
    """Speckle: errors smooth along the line; steps of the camera's pixels; a stripe that has a width."""
    return RangeErrors(
        distance,
        white=sigma * rng.uniform(0, 1),
        waves=sigma * log_uniform(rng, 0.3, 2.0),
        wave_rows=rng.choice([0.0, rng.uniform(0.3, 2.0)]),
        wave_columns=log_uniform(rng, 0.5, 20.0),
        line=sigma * rng.choice([0.0, log_uniform(rng, 0.05, 0.7)]),
        range_power=2.0,
        grazing_power=rng.uniform(0, 1),
        step=rng.choice([0.0, sigma * log_uniform(rng, 0.3, 4.0)], p=[0.4, 0.6]),
        disparity=bool(rng.random() < 0.5),
        beam=rng.choice([0.0, log_uniform(rng, 0.5, 4.0)], p=[0.2, 0.8]),
        curl=rng.uniform(0, 1) ** 2,
        mixed=rng.choice([0.0, rng.uniform(0, 0.5)]),
        grazing=rng.uniform(0.02, 0.4),
        lost=rng.uniform(0, 0.2) ** 2,
    )


def light_errors(rng: np.random.Generator, distance: float, sigma: float) -> RangeErrors:
    """Structured light or stereo: errors that grow with the square of depth, smooth over the matching window."""
    width = log_uniform(rng, 0.6, 8.0)
    return RangeErrors(
        distance,
        white=sigma * rng.uniform(0, 0.7),
        waves=sigma * rng.uniform(0.2, 1.2),
        wave_rows=width,
        wave_columns=width,
        range_power=2.0,
        grazing_power=rng.uniform(0, 1),
        step=rng.choice([0.0, sigma * log_uniform(rng, 0.5, 5.0)], p=[0.3, 0.7]),
        disparity=True,
        mixed=rng.uniform(0, 0.7),
        grazing=rng.uniform(0.05, 0.35),
        lost=rng.uniform(0, 0.3) ** 2,
    )


def flight_errors(rng: np.random.Generator, distance: float, sigma: float) -> RangeErrors:
    """Time of flight: independent errors by the strength of the return, wide waves of multiple paths."""
    width = log_uniform(rng, 4.0, 60.0)
    return RangeErrors(
        distance,
        white=sigma,
        waves=sigma * log_uniform(rng, 0.05, 1.0),
        wave_rows=width,
        wave_columns=width,
        range_power=rng.uniform(1, 2),
        grazing_power=rng.uniform(0.3, 1.0),
        step=sigma * rng.choice([0.0, log_uniform(rng, 0.05, 1.0)]),
        mixed=rng.uniform(0.2, 0.9),
        grazing=rng.uniform(0.02, 0.25),
        lost=rng.uniform(0, 0.2) ** 2,
    )


def lidar_errors(rng: np.random.Generator, distance: float, sigma: float) -> RangeErrors:
    """Independent errors, a bias of each beam, and steps."""
    return RangeErrors(
        distance,
        white=sigma,
        waves=sigma * rng.choice([0.0, rng.uniform(0, 1)]),
        wave_columns=log_uniform(rng, 1.0, 30.0),
        line=sigma * rng.choice([0.0, rng.uniform(0, 1)]),
        range_power=rng.uniform(0, 1),
        grazing_power=rng.uniform(0, 1),
        step=sigma * rng.choice([0.0, log_uniform(rng, 0.1, 3.0)]),
        mixed=rng.uniform(0, 0.5),
        grazing=rng.uniform(0.01, 0.15),
        lost=rng.uniform(0, 0.3) ** 2,
    )


def station_errors(rng: np.random.Generator, distance: float, sigma: float) -> RangeErrors:
    """Return the errors of a terrestrial scanner: small independent ones, mixed pixels at edges."""
    return RangeErrors(
        distance,
        white=sigma,
        range_power=rng.uniform(0, 1),
        grazing_power=rng.uniform(0, 1),
        mixed=rng.uniform(0, 0.8),
        grazing=rng.uniform(0.01, 0.2),
        lost=rng.uniform(0, 0.2) ** 2,
    )


def camera_errors(rng: np.random.Generator, distance: float, sigma: float) -> RangeErrors:
    """Return the errors of a depth camera of one kind or the other."""
    return (light_errors if rng.random() < 0.6 else flight_errors)(rng, distance, sigma)
