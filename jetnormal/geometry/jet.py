"""Weighted fits of an n-jet: the height of a surface over its tangent plane as a truncated Taylor expansion.

    z = J(x, y) = sum_{k=0..n} sum_{j=0..k} beta_{k-j,j} x^(k-j) y^j          (Du et al., CVPR 2023, eq. 1)

Cazals and Pouget, "Estimating differential quantities using polynomial fitting of osculating jets" (2005), show that
the coefficients of degree k of an n-jet fitted to a patch of size h are off by O(h^(n-k+1)), so the normal by O(h^n).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

MAX_ORDER = 4


@lru_cache
def exponents(order: int) -> tuple[tuple[int, int], ...]:
    """Return the exponents (of x, of y) of the monomials of an n-jet, in the order of eq. 1."""
    return tuple((k - j, j) for k in range(order + 1) for j in range(k + 1))


@dataclass(frozen=True)
class Jet:
    """A batch of B fitted jets.

    Attributes:
        coefficients: (B, T) beta of each monomial of `exponents(order)`, T = (order + 1)(order + 2) / 2.
        order: n, the degree of the polynomial.
    """

    coefficients: Tensor
    order: int

    @property
    def normal(self) -> Tensor:
        """(B, 3) unit normals at the origin, on the side of positive z (the paper's eq. 2)."""
        slope = self.coefficients[:, 1:3]
        return torch.nn.functional.normalize(torch.cat([-slope, torch.ones_like(slope[:, :1])], 1), dim=1)

    def heights(self, xy: Tensor) -> Tensor:
        """Evaluate J(x, y) at points (B, k, 2): heights (B, k)."""
        return (monomials(xy, self.order) @ self.coefficients[:, :, None])[:, :, 0]

    def normals_at(self, xy: Tensor) -> Tensor:
        """Evaluate the unit normals (-J_x, -J_y, 1) / |.| of the fitted surface at points (B, k, 2): (B, k, 3)."""
        powers = [torch.ones_like(xy)]
        for _ in range(self.order - 1):
            powers.append(powers[-1] * xy)
        slope_x: Tensor | float = 0.0
        slope_y: Tensor | float = 0.0
        for beta, (a, b) in zip(self.coefficients.unbind(1), exponents(self.order), strict=True):
            if a:
                slope_x = slope_x + a * beta[:, None] * powers[a - 1][..., 0] * powers[b][..., 1]
            if b:
                slope_y = slope_y + b * beta[:, None] * powers[a][..., 0] * powers[b - 1][..., 1]
        assert isinstance(slope_x, Tensor) and isinstance(slope_y, Tensor)
        return torch.nn.functional.normalize(torch.stack([-slope_x, -slope_y, torch.ones_like(slope_x)], 2), dim=2)

    def curvatures(self) -> tuple[Tensor, Tensor]:
        """Compute the principal curvatures and directions at the origin.

        A curvature is positive where the surface bends towards the normal (a bowl seen from inside), and is zero
        for a jet of order 1. Its unit is the inverse of the unit of x, y and z.

        Returns:
            (B, 2) curvatures, the larger first, and (B, 2, 3) unit directions in the tangent plane.
        """
        beta = self.coefficients
        if self.order == 1:
            beta = torch.cat([beta, torch.zeros_like(beta)], dim=1)
        fx, fy, fxx, fxy, fyy = beta[:, 1], beta[:, 2], 2 * beta[:, 3], beta[:, 4], 2 * beta[:, 5]
        second = torch.stack([fxx, fxy, fxy, fyy], 1).view(-1, 2, 2) / (1 + fx**2 + fy**2).sqrt()[:, None, None]
        # With L L^T the first fundamental form, L^-1 II L^-T is symmetric and has the shape operator's eigenvalues.
        first = torch.stack([1 + fx**2, fx * fy, fx * fy, 1 + fy**2], 1).view(-1, 2, 2)
        inverse = torch.linalg.inv(torch.linalg.cholesky(first))
        values, vectors = torch.linalg.eigh(inverse @ second @ inverse.transpose(1, 2))
        uv = (inverse.transpose(1, 2) @ vectors).transpose(1, 2).flip(1)  # (B, 2 directions, 2)
        slope = torch.stack([fx, fy], 1)[:, None]
        directions = torch.cat([uv, (uv * slope).sum(2, keepdim=True)], dim=2)
        return values.flip(1), torch.nn.functional.normalize(directions, dim=2)


def monomials(xy: Tensor, order: int) -> Tensor:
    """Evaluate the T monomials of an n-jet at points (..., 2): (..., T)."""
    x, y = xy[..., 0], xy[..., 1]
    columns = [torch.ones_like(x)]
    for _ in range(order):  # each degree follows from the one before: times x, and the last one times y
        degree = columns[-_triangle_row(len(columns)) :]
        columns += [column * x for column in degree] + [degree[-1] * y]
    return torch.stack(columns, dim=-1)


def _triangle_row(count: int) -> int:
    """Return the length of the last row of a triangle of `count` = 1, 3, 6, 10, ... entries."""
    return int(((8 * count + 1) ** 0.5 - 1) / 2)


def fit_jet(points: Tensor, weights: Tensor | None = None, order: int = 3) -> Jet:
    """Fit z = J(x, y) to each patch by weighted least squares: beta = (A^T W A)^-1 A^T W z.

    Before the fit, x and y are divided by their weighted mean absolute value; the result is scaled back. The normal
    matrix is built and solved in float64, scaled to a unit diagonal.

    A tiny fixed ridge keeps degenerate patches solvable (fewer points than monomials, collinear or coincident points).
    Of all best fits they get the one with the smallest coefficients; a patch whose points all coincide gets the normal
    (0, 0, 1). The fit is differentiable in points and weights.

    Args:
        points: (B, k, 3) float32 or float64, the query at the origin, z close to the normal.
        weights: (B, k) non-negative, or None for ones.
        order: n, 1 to 4.

    Raises:
        ValueError: if the order is out of range.
    """
    if not 1 <= order <= MAX_ORDER:
        raise ValueError(f"the order of a jet is 1 to {MAX_ORDER}, not {order}")
    if weights is None:
        weights = torch.ones_like(points[..., 0])
    xy, z = points[..., :2], points[..., 2]
    total = weights.sum(1).clamp_min(torch.finfo(points.dtype).tiny)
    scale = (weights[..., None] * xy.abs()).sum((1, 2)) / (2 * total)
    scale = torch.where(scale > 1e-6, scale, torch.ones_like(scale))

    # In float32, rounding would outweigh the ridge, and points on two parallel lines would have no Cholesky factor.
    design = monomials((xy / scale[:, None, None]).double(), order)  # (B, k, T)
    weighted = (design * (weights / total[:, None])[..., None]).transpose(1, 2)  # (B, T, k)
    degrees = torch.tensor([a + b for a, b in exponents(order)], device=points.device)
    # On two parallel lines, float32 points do not tell x from x y^2. A smaller ridge on x prefers x.
    low, high = (1e-9, 1e-6) if points.dtype == torch.float32 else (1e-13, 1e-13)
    ridge = torch.where(degrees > 1, high, low).double()
    beta = _solve(weighted @ design, weighted @ z[..., None].double(), ridge).to(points.dtype)
    return Jet(beta / scale[:, None] ** degrees, order)


def _solve(matrix: Tensor, right: Tensor, ridge: Tensor) -> Tensor:
    """Solve (B, T, T) positive semi-definite systems for (B, T, 1) right sides, with a ridge (T,); (B, T)."""
    places = torch.arange(matrix.shape[1], device=matrix.device)
    scale = matrix[:, places, places].clamp_min(1e-30).rsqrt()
    # A monomial that is zero at all points of the patch gets a zero coefficient, by the ridge.
    unit = matrix * scale[:, :, None] * scale[:, None, :]
    unit = unit + torch.diag(ridge)
    if torch.onnx.is_in_onnx_export():  # ONNX has no Cholesky factorization
        return _solve_by_columns(unit, right[..., 0] * scale) * scale
    solution = torch.cholesky_solve(right * scale[:, :, None], torch.linalg.cholesky_ex(unit)[0])
    return solution[..., 0] * scale


def _solve_by_columns(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve (B, T, T) positive definite systems for (B, T) right sides by elementary operations: A = L D L^T."""
    size = matrix.shape[2]
    rest, columns, pivots = matrix, [], []
    for j in range(size):  # column j of L, and what is left of the matrix
        pivots.append(rest[:, j, j])
        columns.append(rest[:, :, j] / pivots[j][:, None])
        rest = rest - columns[j][:, :, None] * rest[:, j, None, :]
    for j in range(size):  # L y = right
        below = torch.arange(size) > j
        right = right - torch.where(below, columns[j] * right[:, j, None], 0.0)
    solution: list[Tensor] = []
    for j in reversed(range(size)):  # D L^T x = y
        value = right[:, j] / pivots[j]
        for known, i in zip(solution, reversed(range(j + 1, size)), strict=True):
            value = value - columns[j][:, i] * known
        solution.append(value)
    return torch.stack(solution[::-1], 1)
