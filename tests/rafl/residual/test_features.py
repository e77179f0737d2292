from dataclasses import replace

import numpy as np
import pytest
import torch
from devices import ON_DEVICES
from scipy.spatial.transform import Rotation

from rafl.fem.material import Material
from rafl.fem.mesh import HexMesh
from rafl.residual.acceleration_field import ResidualField
from rafl.residual.features import GaussPoints, features, polar_decomposition
from rafl.simulation.simulator import Simulator

G = torch.tensor([0.0, 0.0, -9.8], dtype=torch.float64)


@pytest.fixture(scope="module")
def mesh() -> HexMesh:
    return HexMesh.box((2, 2, 1), (0.04, 0.02, 0.02))


@pytest.fixture(scope="module")
def field(mesh: HexMesh) -> tuple[ResidualField, Simulator]:
    torch.manual_seed(3)
    return ResidualField(), Simulator(mesh, Material(), mesh.face_nodes("x-min"))


@pytest.mark.parametrize(
    "F",
    [np.eye(3), np.diag([1.2, 1.2, 0.9]), np.diag([1.3, 0.9, 0.2])],
    ids=["rest", "repeated", "thin"],
)
def test_polar_backward_by_finite_differences(F: np.ndarray, random: np.random.Generator) -> None:
    """For R and the sum of squared stretches, which is smooth where stretches cross."""
    at = torch.tensor(Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix() @ F)[None].requires_grad_()
    weights = torch.tensor(random.normal(size=(3, 3)))

    def value(F: torch.Tensor) -> torch.Tensor:
        R, s = polar_decomposition(F)
        return (R * weights).sum() + (s**2).sum()

    assert torch.autograd.gradcheck(value, (at,), eps=1e-6, atol=1e-6)


def test_features_and_gradients_are_finite_at_exact_rest(mesh: HexMesh) -> None:
    q = torch.tensor(mesh.vertices[None]).requires_grad_()
    v = torch.zeros_like(q).requires_grad_()
    values, _ = features(q, v, GaussPoints.of(mesh, 1070.0), G)
    values.square().sum().backward()
    assert torch.isfinite(values).all()
    assert torch.isfinite(q.grad).all()
    assert torch.isfinite(v.grad).all()
    assert values[..., :31].abs().max() < 1e-9


def test_features_of_a_known_motion(mesh: HexMesh) -> None:
    """q = A x with A = R diag(1.1, 0.9, 1) and v = B q, so F = A and L = B everywhere."""
    R = Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix()
    A = R @ np.diag([1.1, 0.9, 1.0])
    B = np.array([[0.1, 0.4, 0.0], [-0.2, 0.3, 0.5], [0.1, 0.0, -0.6]])
    q = mesh.vertices @ A.T
    values, rotation = features(torch.tensor(q[None]), torch.tensor((q @ B.T)[None]), GaussPoints.of(mesh, 1070.0), G)
    np.testing.assert_allclose(rotation[0, 0, 0].numpy(), R, atol=1e-13)
    one = values[0, 1, 5].numpy()
    local = R.T @ B @ R
    D, W = 0.5 * (local + local.T), 0.5 * (local - local.T)
    dev = D - np.trace(D) / 3 * np.eye(3)
    axial = np.array([W[2, 1], W[0, 2], W[1, 0]])
    expected = np.concatenate(
        [
            [-0.1, 0.0, 0.1],
            (A.T @ A - np.eye(3)).ravel(),
            [0.99 - 1.0],
            np.diag(D),
            [np.trace(D)],
            dev.ravel(),
            [np.sqrt(0.5 * (dev**2).sum())],
            axial,
            [2 * np.linalg.norm(axial)],
            R.T @ G.numpy(),
        ]
    )
    np.testing.assert_allclose(one, expected, atol=1e-12)


def test_force_rotates_with_the_body(field: tuple[ResidualField, Simulator], random: np.random.Generator) -> None:
    model, simulator = field
    rotation = torch.tensor(Rotation.from_rotvec([0.2, 1.0, -0.4]).as_matrix())
    q = torch.tensor(simulator.mesh.vertices + random.normal(0, 1e-3, simulator.mesh.vertices.shape))[None]
    v = torch.tensor(random.normal(0, 0.2, q.shape))
    gx, gy, gz = (rotation @ torch.tensor(simulator.gravity, dtype=torch.float64)).tolist()
    rotated = Simulator(simulator.mesh, simulator.material, simulator.fixed, gravity=(gx, gy, gz))
    force = model.on(simulator)(q, v, 0 * q)
    torch.testing.assert_close(
        model.on(rotated)(q @ rotation.T, v @ rotation.T, 0 * q), force @ rotation.T, atol=1e-12, rtol=1e-9
    )


@pytest.mark.parametrize("mirrors", [[False, True, False], [False, True, True], [True, True, True]])
def test_mirrored_motion_gives_the_mirrored_force(
    mesh: HexMesh, mirrors: list[bool], random: np.random.Generator
) -> None:
    """With mirrored gravity, and only for the axes in which the field is symmetric."""
    torch.manual_seed(3)
    model = ResidualField()
    model.impose_symmetry(torch.tensor(mirrors))
    q = mesh.vertices + random.normal(0, 1e-3, mesh.vertices.shape)
    v = random.normal(0, 0.2, q.shape)
    gravity = np.array([1.0, 3.0, -9.0])

    def force(q: np.ndarray, v: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        simulator = Simulator(mesh, Material(), mesh.face_nodes("x-min"), gravity=tuple(gravity.tolist()))
        with torch.no_grad():
            states = (torch.tensor(x[None]) for x in (q, v, 0.0 * v))
            return model.on(simulator)(*states)[0].numpy()

    for axis, mirrored in enumerate(mirrors):
        sign = 1.0 - 2.0 * np.eye(3)[axis]
        width = np.ptp(mesh.vertices[:, axis])
        there = (mesh.vertices - width * np.eye(3)[axis]) * sign
        image = np.linalg.norm(mesh.vertices[:, None] - there[None], axis=-1).argmin(axis=1)
        found = force((q[image] * sign) + width * np.eye(3)[axis], v[image] * sign, gravity * sign)
        expected = force(q, v, gravity)[image] * sign
        assert np.allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max()) == mirrored


def test_width_must_be_a_multiple_of_eight() -> None:
    with pytest.raises(ValueError, match="multiple of 8, got 20"):
        ResidualField(width=20)


def test_force_by_finite_differences(field: tuple[ResidualField, Simulator], random: np.random.Generator) -> None:
    model, simulator = field
    q = torch.tensor(simulator.mesh.vertices + random.normal(0, 1e-3, simulator.mesh.vertices.shape))[None]
    v = torch.tensor(random.normal(0, 0.2, q.shape))
    force = model.on(simulator)
    c, dq, dv = (torch.tensor(random.normal(size=q.shape)) for _ in range(3))
    q.requires_grad_()
    v.requires_grad_()
    (force(q, v, 0 * q) * c).sum().backward()
    h = 1e-6
    with torch.no_grad():
        slope = ((force(q + h * dq, v + h * dv, q) - force(q - h * dq, v - h * dv, q)) * c).sum() / (2 * h)
    assert q.grad is not None
    assert v.grad is not None
    assert float((q.grad * dq + v.grad * dv).sum()) == pytest.approx(float(slope), rel=1e-5)


@ON_DEVICES
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("at_rest", [True, False])
def test_fields_in_kernels_and_tensors_agree(
    at_rest: bool, mirrored: bool, device: str, random: np.random.Generator
) -> None:
    """Forces and all derivatives of several deformed states, and at rest, on a mesh with a missing cell."""
    torch.manual_seed(1)
    model = ResidualField()
    model.scale.copy_(torch.linspace(0.5, 20.0, 34))
    model.impose_symmetry(torch.tensor([False, mirrored, mirrored]))
    cells = np.ones((3, 2, 2), dtype=bool)
    cells[2, 1] = False
    mesh = HexMesh.from_grid(cells, (0.01, 0.012, 0.008))
    simulator = Simulator(mesh, Material(), mesh.face_nodes("x-min"))
    moves = 0.0 if at_rest else random.normal(0, 2e-3, (3, *mesh.vertices.shape))
    q = torch.tensor(mesh.vertices + moves + np.zeros((3, 1, 1)))
    v = torch.tensor(random.normal(0, 0.3, q.shape) * (not at_rest))
    c = torch.tensor(random.normal(size=q.shape))
    results = []
    for force in (model.on(simulator), model.on(replace(simulator, arithmetic="torch", device=device))):
        leaves = [q.clone().requires_grad_(), v.clone().requires_grad_()]
        value = force(*leaves, 0 * q)
        results.append([value, *torch.autograd.grad((value * c).sum(), [*leaves, *model.parameters()])])
    for number, (compiled, tensors) in enumerate(zip(*results, strict=True)):
        assert torch.isfinite(compiled).all()
        if at_rest and number == 1:
            continue  # for equal stretches the order, and so the derivative of each feature, is not unique
        torch.testing.assert_close(compiled, tensors, rtol=1e-8, atol=1e-11 * float(tensors.detach().abs().max()))


def test_weights_by_finite_differences(field: tuple[ResidualField, Simulator], random: np.random.Generator) -> None:
    model, simulator = field
    q = torch.tensor(simulator.mesh.vertices + random.normal(0, 1e-3, simulator.mesh.vertices.shape))[None]
    v = torch.tensor(random.normal(0, 0.2, q.shape))
    c = torch.tensor(random.normal(size=q.shape))
    model.zero_grad()
    (model.on(simulator)(q, v, 0 * q) * c).sum().backward()
    for weight in model.parameters():
        direction = torch.tensor(random.normal(size=weight.shape))
        assert weight.grad is not None
        gradient = float((weight.grad * direction).sum())
        with torch.no_grad():
            values = []
            for sign in (1, -1):
                weight += sign * 1e-6 * direction
                values.append(float((model.on(simulator)(q, v, 0 * q) * c).sum()))
                weight -= sign * 1e-6 * direction
        assert gradient == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-5)


def test_uniform_acceleration_gives_mass_times_acceleration(mesh: HexMesh) -> None:
    """The nodal forces of a uniform acceleration add up to mass * acceleration."""
    points = GaussPoints.of(mesh, 1000.0)
    acceleration = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).expand(1, len(mesh.hexes), 8, 3)
    force = points.accumulate(acceleration, len(mesh.vertices))
    np.testing.assert_allclose(force[0].sum(0).numpy(), 0.016 * np.array([1.0, 2.0, 3.0]))


def test_scaled_features_are_dimensionless_and_balanced(random: np.random.Generator) -> None:
    """The inputs do not depend on the unit of rates, and features that training hardly excites do not dominate."""
    model, size = ResidualField(), torch.tensor(random.uniform(0.5, 2.0, 34))
    size[[5, 20]] = torch.tensor([1e-9, 0.0], dtype=torch.float64)
    model.set_scale(size)
    inputs = model.scale * size
    other = size.clone()
    other[13:31] *= 1000.0
    model.set_scale(other)
    assert torch.allclose(model.scale * other, inputs)
    assert model.scale[:13].max() < 50.0 * model.scale[:13].min()
    without_gravity = size.clone()
    without_gravity[31:] = 0.0
    model.set_scale(without_gravity)
    assert torch.isfinite(model.scale).all()
