from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from jetnormal.geometry.jet import MAX_ORDER, exponents, fit_jet, monomials

ORDERS = range(1, MAX_ORDER + 1)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scattered(batch: int, count: int, seed: int = 0) -> torch.Tensor:
    """(batch, count, 2) positions in [-0.8, 0.6] x [-0.5, 0.9], denser to one side; the first one is the origin."""
    xy = torch.rand(batch, count, 2, dtype=torch.float64, generator=generator(seed)) ** 1.3 * 1.4
    xy = xy - torch.tensor([0.8, 0.5])
    xy[:, 0] = 0
    return xy


def polynomial_patches(order: int, batch: int, count: int = 60, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """(batch, count, 3) points of random polynomials of a degree, and their (batch, T) coefficients."""
    coefficients = torch.randn(batch, len(exponents(order)), dtype=torch.float64, generator=generator(seed + 1)) / 2
    xy = scattered(batch, count, seed)
    z = sum(
        beta[:, None] * xy[..., 0] ** a * xy[..., 1] ** b
        for beta, (a, b) in zip(coefficients.unbind(1), exponents(order), strict=True)
    )
    return torch.cat([xy, z[..., None]], dim=2), coefficients


def surface(count: int, size: float, height, seed: int = 0) -> torch.Tensor:
    """(1, count, 3) points of z = height(x, y) over a lopsided set of positions of a size; the origin comes first."""
    xy = scattered(1, count, seed) * size
    return torch.cat([xy, height(xy[..., 0], xy[..., 1])[..., None]], dim=2)


def turned(points: torch.Tensor, angle: float) -> torch.Tensor:
    """Points turned about z."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=points.dtype)


def angle_to(normals: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Radians between directions with signs; exact for small angles, unlike the arc cosine."""
    return torch.atan2(torch.linalg.cross(normals, true, dim=-1).norm(dim=-1), (normals * true).sum(-1))


def test_the_monomials_follow_the_equation():
    assert exponents(2) == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    xy = scattered(2, 5)
    expected = torch.stack([xy[..., 0] ** a * xy[..., 1] ** b for a, b in exponents(4)], dim=-1)
    torch.testing.assert_close(monomials(xy, 4), expected)


@pytest.mark.parametrize("batch", [1, 17])
@pytest.mark.parametrize("order", ORDERS)
def test_a_polynomial_is_recovered_exactly(order, batch):
    points, coefficients = polynomial_patches(order, batch)
    weights = 0.01 + torch.rand(points.shape[:2], dtype=torch.float64, generator=generator(5))
    for given in (weights, 1000 * weights, None):
        jet = fit_jet(points, given, order)
        torch.testing.assert_close(jet.coefficients, coefficients, rtol=0, atol=1e-9)
    single = fit_jet(points.float(), weights.float(), order)
    assert single.coefficients.dtype == single.normal.dtype == torch.float32
    torch.testing.assert_close(single.coefficients.double(), coefficients, rtol=0, atol=1e-3)
    torch.testing.assert_close(single.normal.double(), jet.normal, rtol=0, atol=1e-4)


@pytest.mark.parametrize("order", ORDERS)
def test_a_lower_order_is_recovered_by_a_higher_one(order):
    points, coefficients = polynomial_patches(1, 3)
    jet = fit_jet(points, None, order)
    torch.testing.assert_close(jet.coefficients[:, :3], coefficients, rtol=0, atol=1e-9)
    torch.testing.assert_close(jet.coefficients[:, 3:], torch.zeros_like(jet.coefficients[:, 3:]), rtol=0, atol=1e-9)


def test_each_patch_of_a_batch_is_fitted_as_if_alone():
    points, _ = polynomial_patches(4, 17)
    weights = 0.01 + torch.rand(points.shape[:2], dtype=torch.float64, generator=generator(5))
    batch = fit_jet(points, weights, 3)
    for i in range(17):
        alone = fit_jet(points[i : i + 1], weights[i : i + 1], 3)
        torch.testing.assert_close(batch.coefficients[i : i + 1], alone.coefficients, rtol=0, atol=1e-11)


@pytest.mark.parametrize("order", [0, MAX_ORDER + 1])
def test_other_orders_are_refused(order):
    with pytest.raises(ValueError, match="the order of a jet is 1 to 4"):
        fit_jet(torch.zeros(1, 20, 3), None, order)


@pytest.mark.parametrize("order", ORDERS)
def test_normals_at_the_neighbors_are_those_of_the_gradient(order):
    points, coefficients = polynomial_patches(order, 4)
    jet = fit_jet(points, None, order)
    x, y = points[..., 0], points[..., 1]
    slope_x, slope_y = torch.zeros_like(x), torch.zeros_like(x)
    for beta, (a, b) in zip(coefficients.unbind(1), exponents(order), strict=True):
        if a:
            slope_x += beta[:, None] * a * x ** (a - 1) * y**b
        if b:
            slope_y += beta[:, None] * b * x**a * y ** (b - 1)
    true = torch.stack([-slope_x, -slope_y, torch.ones_like(x)], dim=2)
    normals = jet.normals_at(points[..., :2])
    torch.testing.assert_close(normals, true / true.norm(dim=2, keepdim=True), rtol=0, atol=1e-9)
    torch.testing.assert_close(normals[:, 0], jet.normal)
    torch.testing.assert_close(jet.heights(points[..., :2]), points[..., 2], rtol=0, atol=1e-9)


def test_normals_at_the_neighbors_of_a_small_patch():
    # positions that are scaled for the fit must not stay scaled here: the normals would turn by several degrees
    points, _ = polynomial_patches(2, 1)
    small = points * 0.01
    torch.testing.assert_close(
        fit_jet(small, None, 2).normals_at(small[..., :2]), fit_jet(points, None, 2).normals_at(points[..., :2])
    )


@pytest.mark.parametrize("order", [2, 3, 4])
@pytest.mark.parametrize("a, b", [(0.7, -0.4), (1.5, 0.2), (-0.3, -0.9)])
@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
def test_curvatures_of_a_turned_quadric(order, a, b, angle):
    points = turned(surface(60, 1.0, lambda x, y: (a * x**2 + b * y**2) / 2), angle)
    curvatures, directions = fit_jet(points, None, order).curvatures()
    expected = torch.tensor([[max(a, b), min(a, b)]], dtype=torch.float64)
    torch.testing.assert_close(curvatures, expected, rtol=0, atol=1e-9)
    axis = turned(torch.eye(3, dtype=torch.float64)[0 if a > b else 1], angle)
    assert abs(directions[0, 0] @ axis) == pytest.approx(1, abs=1e-9)
    assert abs(directions[0, 0] @ directions[0, 1]) < 1e-9


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.5, -0.3)])
def test_curvatures_on_a_sphere(slope):
    """The upper cap of a sphere of radius 2, seen along z; with a slope the query is away from its top."""
    radius, size = 2.0, 0.02
    p, q = slope
    top = torch.tensor([-p, -q, 1.0], dtype=torch.float64) * radius / np.sqrt(1 + p**2 + q**2)  # query - center

    def height(x, y):
        return (radius**2 - (x + top[0]) ** 2 - (y + top[1]) ** 2).sqrt() - top[2]

    jet = fit_jet(surface(80, size, height), None, 4)
    curvatures, directions = jet.curvatures()
    torch.testing.assert_close(curvatures, torch.full((1, 2), -1 / radius, dtype=torch.float64), rtol=0, atol=1e-5)
    torch.testing.assert_close(jet.normal[0], top / radius, rtol=0, atol=1e-7)
    torch.testing.assert_close((directions @ jet.normal[0])[0], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-9)
    torch.testing.assert_close(directions.norm(dim=2), torch.ones(1, 2, dtype=torch.float64))


def test_a_bowl_has_positive_curvatures_and_a_dome_negative_ones():
    bowl = surface(50, 1.0, lambda x, y: x**2 + y**2)
    dome = bowl * torch.tensor([1.0, 1, -1])
    assert (fit_jet(bowl, None, 2).curvatures()[0] > 1.9).all()
    assert (fit_jet(dome, None, 2).curvatures()[0] < -1.9).all()


def test_curvatures_on_a_cylinder():
    """Of radius 0.5, its axis turned in the plane: 2 across and 0 along, bending away from the normal."""
    points = turned(surface(80, 0.02, lambda x, y: (0.25 - x**2).sqrt() - 0.5), 0.7)
    curvatures, directions = fit_jet(points, None, 4).curvatures()
    torch.testing.assert_close(curvatures, torch.tensor([[0.0, -2.0]], dtype=torch.float64), rtol=0, atol=1e-5)
    along = turned(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), 0.7)
    assert abs(directions[0, 0] @ along) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_curvatures_on_a_torus(tilt):
    """At angle u of the tube: 1 / r around the tube, cos u / (R + r cos u) around the axis (do Carmo, 3-3).

    With a tilt the fit's z is not the normal, and the principal directions are not those of the second derivatives.
    """
    ring, tube, u = 1.0, 0.4, 0.5
    normal = torch.tensor([np.cos(u), 0, np.sin(u)], dtype=torch.float64)  # outward, at v = 0
    frame = torch.stack([torch.tensor([-np.sin(u), 0, np.cos(u)]), torch.tensor([0.0, -1, 0]).double(), normal], dim=1)
    du, dv = (scattered(1, 80) * 0.04).unbind(2)
    x = (ring + tube * (u + du).cos()) * dv.cos()
    y = (ring + tube * (u + du).cos()) * dv.sin()
    points = torch.stack([x, y, tube * (u + du).sin()], dim=2)
    frame = frame @ torch.from_numpy(Rotation.from_rotvec([tilt, -0.7 * tilt, 0.3]).as_matrix())
    jet = fit_jet((points - points[:, :1]) @ frame, None, 4)
    curvatures, directions = jet.curvatures()
    around = -np.cos(u) / (ring + tube * np.cos(u))
    torch.testing.assert_close(curvatures, torch.tensor([[around, -1 / tube]], dtype=torch.float64), rtol=0, atol=3e-4)
    axes = torch.tensor([[0.0, 1, 0], [-np.sin(u), 0, np.cos(u)]], dtype=torch.float64)  # around the axis, the tube
    cosines = (directions[0] * (axes @ frame)).sum(1).abs()
    torch.testing.assert_close(cosines, torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-6)
    torch.testing.assert_close(jet.normal[0], normal @ frame, rtol=0, atol=1e-6)


def test_curvatures_converge_on_a_sphere_at_order_2():
    """The degree 2 of an n-jet is off by O(h^(n-1)); on a lopsided patch of order 2 that is h."""

    def error(size):
        points = surface(80, size, lambda x, y: 1 - (1 - (x + 0.3) ** 2 - y**2).sqrt() - (1 - np.sqrt(0.91)))
        return (fit_jet(points, None, 2).curvatures()[0] - 1).abs().max().item()

    assert error(0.1) < 0.1
    assert error(0.01) < 0.2 * error(0.1)
    assert error(0.001) < 0.2 * error(0.01)


def test_a_plane_has_no_curvature():
    points, coefficients = polynomial_patches(1, 1)
    for order in ORDERS:
        jet = fit_jet(points, None, order)
        assert jet.curvatures()[0].abs().max() < 1e-9
        true = torch.tensor([[-coefficients[0, 1], -coefficients[0, 2], 1]], dtype=torch.float64)
        torch.testing.assert_close(jet.normal, true / true.norm(), rtol=0, atol=1e-9)


def test_points_of_weight_zero_do_not_count():
    points, coefficients = polynomial_patches(3, 2)
    weights = torch.ones(points.shape[:2], dtype=torch.float64)
    weights[:, 10:20] = 0
    points[:, 10:20] += 5 * torch.randn(2, 10, 3, dtype=torch.float64, generator=generator(3))
    assert (fit_jet(points, None, 3).coefficients - coefficients).abs().max() > 0.1
    torch.testing.assert_close(fit_jet(points, weights, 3).coefficients, coefficients, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 0.1, 50.0])
def test_scaling_keeps_the_normal_and_divides_the_curvatures(scale):
    points, _ = polynomial_patches(4, 3)
    jet, scaled = fit_jet(points, None, 3), fit_jet(points * scale, None, 3)
    torch.testing.assert_close(scaled.normal, jet.normal, rtol=0, atol=1e-9)
    torch.testing.assert_close(scaled.curvatures()[0] * scale, jet.curvatures()[0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("order", ORDERS)
def test_gradients_through_points_and_weights(order):
    points, _ = polynomial_patches(min(order + 1, 4), 2, count=20)
    points.requires_grad_()
    weights = (0.1 + torch.rand(2, 20, dtype=torch.float64, generator=generator(5))).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, w: fit_jet(p, w, order).normal, (points, weights))
    assert torch.autograd.gradcheck(lambda p, w: fit_jet(p, w, order).normals_at(p[:, :3, :2]), (points, weights))


def degenerate_patches(kind: str, count: int) -> torch.Tensor:
    """(40, count, 3) patches that leave some monomials undetermined."""
    rng = np.random.default_rng(0)
    t = rng.uniform(-1, 1, (40, count))
    if kind == "coincident":
        points = np.zeros((40, count, 3))
    elif kind == "collinear":
        points = t[..., None] * rng.normal(size=(40, 1, 3))
    elif kind == "two scan lines":
        points = np.stack([t, rng.choice([-0.3, 0.5], t.shape), 0.1 * t**2], axis=2)
    elif kind == "ring":
        points = np.stack([np.cos(3 * t), np.sin(3 * t), 0 * t], axis=2)
    elif kind == "repeated points":
        points = rng.uniform(-1, 1, (40, 4, 3))[np.arange(40)[:, None], rng.integers(0, 4, t.shape)]
    else:  # "vertical line"
        points = np.stack([1e-9 * t, 0 * t, t], axis=2)
    return torch.from_numpy(points)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 5, 256, 700])
@pytest.mark.parametrize(
    "kind", ["coincident", "collinear", "two scan lines", "ring", "repeated points", "vertical line"]
)
def test_degenerate_patches_have_a_finite_deterministic_fit(kind, count, dtype, monkeypatch):
    factorised = []
    factorise = torch.linalg.cholesky_ex
    monkeypatch.setattr(
        torch.linalg, "cholesky_ex", lambda matrix: factorised.append(factorise(matrix)) or factorised[-1]
    )
    points = degenerate_patches(kind, count).to(dtype).requires_grad_()
    for order in ORDERS:
        jet = fit_jet(points, None, order)
        assert not factorised[-1].info.any()  # a failed factorisation would leave arbitrary numbers
        assert torch.isfinite(jet.coefficients).all()
        torch.testing.assert_close(jet.normal.norm(dim=1), torch.ones(40, dtype=dtype))
        assert torch.equal(jet.coefficients, fit_jet(points, None, order).coefficients)
        (gradient,) = torch.autograd.grad(jet.normal.sum(), points)
        assert torch.isfinite(gradient).all()


def test_coincident_points_have_the_normal_z():
    for order in ORDERS:
        normal = fit_jet(torch.zeros(2, 10, 3), None, order).normal
        assert torch.equal(normal, torch.tensor([[0.0, 0, 1]]).expand(2, 3))


@pytest.mark.parametrize("order, limit", [(1, 0.01), (2, 0.01), (3, 5.0), (4, 5.0)])
def test_two_scan_lines_on_a_plane(order, limit):
    """Two lines do not tell x from x y^2: the ridge shares the slope among them, and stays near the plane."""
    points = degenerate_patches("two scan lines", 700)
    points[..., 2] = 0.2 * points[..., 0]
    true = torch.tensor([-0.2, 0.0, 1.0]).expand(40, 3)
    assert angle_to(fit_jet(points.float(), None, order).normal, true).max() < np.radians(limit)


@pytest.mark.parametrize("order", ORDERS)
def test_the_normal_converges_as_the_order_promises(order):
    """The error of the normal falls as h^n (the paper's eq. 4 with k = 1).

    On a symmetric neighborhood the terms of odd degree cancel and an even order gains one, hence lopsided ones. The
    mean over several of them is taken, since the constant of a single one may vanish by chance.
    """

    def height(x, y):
        return torch.sin(0.9 * x + 0.3) * torch.exp(0.7 * y - 0.2 * x) + 0.2 * torch.cos(1.3 * y + x) - offset

    offset = np.sin(0.3) + 0.2
    slope_x = 0.9 * np.cos(0.3) - 0.2 * np.sin(0.3)  # of the height at the origin, by hand
    slope_y = 0.7 * np.sin(0.3)
    true = torch.tensor([[-slope_x, -slope_y, 1]], dtype=torch.float64)
    sizes = [0.4, 0.2, 0.1, 0.05]
    errors = [
        np.mean([angle_to(fit_jet(surface(60, h, height, seed), None, order).normal, true) for seed in range(8)])
        for h in sizes
    ]
    rate = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert rate == pytest.approx(order, abs=0.35)


@pytest.mark.parametrize("order", [2, 3, 4])
def test_two_scan_lines_on_a_plane_give_its_slope(order):
    x = torch.linspace(-1, 1, 60, dtype=torch.float64).repeat(2)
    y = torch.tensor([0.0, 0.3], dtype=torch.float64).repeat_interleave(60)
    points = torch.stack([x, y, 0.2 * x + 0.1 * y], 1)[None].float()
    true = torch.tensor([-0.2, -0.1, 1.0], dtype=torch.float64)
    cosine = fit_jet(points, None, order).normal[0].double() @ (true / true.norm())
    assert torch.rad2deg(torch.arccos(cosine.clamp(max=1))) < 0.1
