"""A robot file moves as Drake moves it: dynamics, derivatives, linearisation, regulators."""

# Drake's stubs mistype vectors.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalSubscript=false

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import LinearQuadraticRegulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Linearize

from ocp.equilibrium import equilibrium_input, linearise
from ocp.models.multibody import MultibodyModel, multibody_model
from ocp.models.plant_file import Thruster
from ocp.models.recursion import by_recursion
from ocp.models.robots import ROBOTS, robot_file
from ocp.models.symbolic_translation import ExpressionTooLargeError, by_symbols
from ocp.riccati import LinearQuadratic, algebraic_riccati

BOTH = {"by_symbols": by_symbols, "by_recursion": by_recursion}
SAMPLES = 1000

# Where each robot can rest, and how far from there (in each coordinate) its regulator is shown to
# bring it back.
RESTS = {
    "pendulum": ([np.pi, 0], 0.1),
    "cart_pole": ([0.5, np.pi, 0, 0], 0.1),
    "acrobot": ([np.pi, 0, 0, 0], 0.01),
    "planar_quadrotor": ([1, -1, 0, 0, 0, 0], 0.3),
    "two_link_arm": ([2.0, 0.7, 0, 0], 0.3),
    "spatial_quadrotor": ([1, 2, -1, 0, 0, 0.4, 0, 0, 0, 0, 0, 0], 0.2),
}


def samples(model: MultibodyModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random states of the domain and inputs that the actuators can do."""
    rng = np.random.default_rng(0)
    system = model.system
    states = rng.uniform(system.lower, system.upper, (count, system.n))
    lower = [max(i.lower, -20.0) for i in system.inputs]
    upper = [min(i.upper, 20.0) for i in system.inputs]
    return states, rng.uniform(lower, upper, (count, system.m))


def drake_rates(model: MultibodyModel, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    diagram = model.diagram()
    context = diagram.CreateDefaultContext()
    rates = []
    for x, u in zip(model.to_drake(states), inputs, strict=True):
        context.SetContinuousState(x)
        diagram.GetInputPort("u").FixValue(context, u)
        rates.append(diagram.EvalTimeDerivatives(context).CopyToVector())
    return model.from_drake(np.array(rates))


@pytest.fixture(params=ROBOTS, scope="module")
def model(request: pytest.FixtureRequest) -> MultibodyModel:
    return multibody_model(robot_file(request.param))


@pytest.mark.parametrize("dynamics", BOTH.values(), ids=BOTH)
@pytest.mark.parametrize("robot", ROBOTS)
def test_dynamics_equal_drakes(robot: str, dynamics) -> None:
    """Rounding grows with the condition of the mass matrix: 1e-10 of the largest rate."""
    model = multibody_model(robot_file(robot), dynamics=dynamics)
    states, inputs = samples(model, SAMPLES)
    expected = drake_rates(model, states, inputs)
    rates = np.array(model.system.dynamics(states.T, inputs.T)).T
    error = np.abs(rates - expected).max(axis=1) / np.abs(expected).max(axis=1)
    assert error.max() < 1e-10


def test_derivatives_equal_drakes_automatic_ones(model: MultibodyModel) -> None:
    from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

    states, inputs = samples(model, 20)
    diagram = model.diagram().ToAutoDiffXd()
    context = diagram.CreateDefaultContext()
    n = model.system.n
    for x, u in zip(states, inputs, strict=True):
        both = InitializeAutoDiff(np.concatenate([model.to_drake(x), u])).ravel()
        context.SetContinuousState(both[:n])
        diagram.GetInputPort("u").FixValue(context, both[n:])
        rates = diagram.EvalTimeDerivatives(context).CopyToVector()
        gradient = ExtractGradient(rates.reshape(-1, 1))
        order = model.order
        A, B = linearise(model.system, x, u)
        scale = np.abs(gradient).max()
        assert_allclose(A, gradient[:, :n][np.ix_(order, order)], atol=1e-10 * scale)
        assert_allclose(B, gradient[:, n:][order], atol=1e-10 * scale)


def test_linearisation_and_regulator_agree_three_ways(model: MultibodyModel) -> None:
    """Ours, Drake's Linearize and LinearQuadraticRegulator, and python-control."""
    import control

    rest = np.array(RESTS[model.system.name][0], dtype=float)
    u = equilibrium_input(model.system, rest)
    A, B = linearise(model.system, rest, u)
    diagram = model.diagram()
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(model.to_drake(rest))
    diagram.GetInputPort("u").FixValue(context, u)
    linear = Linearize(diagram, context)
    order = model.order
    scale = np.abs(A).max()
    assert_allclose(A, np.array(linear.A())[np.ix_(order, order)], atol=1e-8 * scale)
    assert_allclose(B, np.array(linear.B())[order], atol=1e-8 * np.abs(B).max())

    M, R = np.diag(np.linspace(1.0, 2.0, len(A))), np.diag(np.linspace(0.5, 1.0, B.shape[1]))
    ours = algebraic_riccati(LinearQuadratic(A, B, M, R, rest))
    K_drake, P_drake = LinearQuadraticRegulator(A, B, M, R)
    K_control, P_control, _ = control.lqr(A, B, M, R)
    for P in (P_drake, P_control):
        assert_allclose(ours.P(), P, atol=1e-8 * np.abs(ours.P()).max())
    for K in (K_drake, K_control):
        assert_allclose(ours.gain(), K, atol=1e-8 * np.abs(ours.gain()).max())


def test_the_regulator_stabilises_the_robot_in_drakes_simulator(model: MultibodyModel) -> None:
    """From the corners of the stated region, with the actuators' limits, back to rest."""
    from ocp.models.drake_adaptors import StateFeedback

    rest, reach = np.array(RESTS[model.system.name][0], dtype=float), RESTS[model.system.name][1]
    system = model.system
    u = equilibrium_input(system, rest)
    A, B = linearise(system, rest, u)
    regulator = algebraic_riccati(LinearQuadratic(A, B, np.eye(system.n), np.eye(system.m), rest))
    lower = np.array([i.lower for i in system.inputs])
    upper = np.array([i.upper for i in system.inputs])

    def law(drake_state: np.ndarray) -> np.ndarray:
        return np.clip(u + regulator.input(model.from_drake(drake_state)), lower, upper)

    builder = DiagramBuilder()
    robot = builder.AddSystem(model.diagram())
    feedback = builder.AddSystem(StateFeedback(law, system.n, system.m))
    builder.Connect(robot.GetOutputPort("state"), feedback.get_input_port())
    builder.Connect(feedback.get_output_port(), robot.GetInputPort("u"))
    simulator = Simulator(builder.Build())
    simulator.get_mutable_integrator().set_target_accuracy(1e-6)
    rng = np.random.default_rng(0)
    seconds = min(30.0, np.log(1e3) / regulator.decay_rate + 2.0)
    for _ in range(3):
        offset = reach * rng.choice([-1.0, 1.0], system.n)
        offset[len(offset) // 2 :] *= 0.5
        simulator.get_mutable_context().SetTime(0.0)
        simulator.get_mutable_context().SetContinuousState(model.to_drake(rest + offset))
        simulator.Initialize()
        simulator.AdvanceTo(seconds)
        end = simulator.get_context().get_continuous_state_vector().CopyToVector()
        assert np.abs(model.from_drake(end) - rest).max() < 0.05 * reach


def test_states_travel_to_drake_and_back() -> None:
    model = multibody_model(robot_file("spatial_quadrotor"))
    x = np.random.default_rng(0).normal(size=(4, 12))
    assert_allclose(model.from_drake(model.to_drake(x)), x, rtol=0)
    assert model.system.coordinates[0].name.endswith("x")
    assert [c.unit for c in model.system.coordinates[:4]] == ["m", "m", "m", "rad"]


def inertia() -> SpatialInertia:
    return SpatialInertia(1.3, [0.1, 0.02, -0.3], UnitInertia(0.4, 0.45, 0.5, 0.01, -0.02, 0.03))


def chain(joints: int) -> MultibodyPlant:
    """A chain in space whose axes turn, with offsets, damping, springs and geared rotors."""
    plant = MultibodyPlant(0.0)
    parent = plant.world_body()
    for i in range(joints):
        body = plant.AddRigidBody(f"b{i}", inertia())
        offset = RigidTransform([0.05, 0.1, -0.5])
        frame = plant.AddFrame(FixedOffsetFrame(f"f{i}", parent.body_frame(), offset))
        back = plant.AddFrame(
            FixedOffsetFrame(f"m{i}", body.body_frame(), RigidTransform([0.0, 0.02, 0.1]))
        )
        axis = np.roll([1.0, 0.2, 0.0], i)
        if i % 3 == 1:
            joint = plant.AddJoint(PrismaticJoint(f"j{i}", frame, back, axis))
            plant.AddForceElement(PrismaticSpring(joint, 0.2, 3.0))
        else:
            joint = plant.AddJoint(RevoluteJoint(f"j{i}", frame, back, axis, 0.3))
            plant.AddForceElement(RevoluteSpring(joint, 0.4, 2.0))
        motor = plant.AddJointActuator(f"a{i}", joint, 50.0)
        motor.set_default_rotor_inertia(1e-3)
        motor.set_default_gear_ratio(20.0)
        parent = body
    tool = plant.AddRigidBody("tool", inertia())
    plant.AddJoint(
        WeldJoint("weld", parent.body_frame(), tool.body_frame(), RigidTransform([0.1, 0.0, -0.2]))
    )
    plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("dynamics", "joints"), [(by_symbols, 2), (by_recursion, 2), (by_recursion, 7)]
)
def test_springs_rotors_offsets_and_welds_are_taken_along(dynamics, joints: int) -> None:
    model = multibody_model(chain(joints), dynamics=dynamics)
    states, inputs = samples(model, 50)
    expected = drake_rates(model, states, inputs)
    rates = np.array(model.system.dynamics(states.T, inputs.T)).T
    assert_allclose(rates, expected, atol=1e-10 * np.abs(expected).max())


def test_mass_is_symmetric_and_both_ways_agree_on_every_part() -> None:
    plant = chain(2)
    a, b = by_symbols(plant), by_recursion(plant)
    rng = np.random.default_rng(1)
    q, v = rng.normal(size=(2, 2))
    for part in ("mass", "force", "kinematics"):
        one, other = (
            np.array(ca.Function("f", [e.q, e.v], [getattr(e, part)])(q, v)) for e in (a, b)
        )
        assert_allclose(one, other, rtol=1e-11, atol=1e-12)
        if part == "mass":
            assert_allclose(one, one.T, atol=1e-14)
            assert np.linalg.eigvalsh(one).min() > 0


def test_a_long_chain_is_refused_early_with_the_way_out() -> None:
    with pytest.raises(ExpressionTooLargeError, match=r"too large .* dynamics=by_recursion"):
        multibody_model(chain(7))


def test_a_propeller_can_be_given_in_python() -> None:
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("cart", inertia())
    plant.AddJoint(PrismaticJoint("rail", plant.world_frame(), body.body_frame(), [0, 0, 1]))
    plant.Finalize()
    model = multibody_model(plant, thrusters=[Thruster("cart", 0.1, 30.0)])
    assert model.system.inputs[0].upper == 30.0
    states, inputs = samples(model, 5)
    rates = np.array(model.system.dynamics(states.T, inputs.T)).T
    assert_allclose(rates[:, 1], inputs[:, 0] / 1.3 - 9.81, rtol=1e-12)


def floating(free: bool) -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("body", inertia())
    if not free:
        plant.AddJoint(BallRpyJoint("ball", plant.world_frame(), body.body_frame()))
    plant.Finalize()
    return plant


def still() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (lambda: MultibodyPlant(0.0), "must be finalized"),
        (still, "no degree of freedom"),
        (lambda: floating(True), "no actuator and no propeller"),
    ],
)
def test_what_cannot_be_a_robot_is_refused(source, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        multibody_model(source())


@pytest.mark.parametrize(
    ("free", "message"),
    [(True, "add a RpyFloatingJoint"), (False, "BallRpyJoint, which is not supported")],
)
def test_unsupported_joints_are_named(free: bool, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        multibody_model(floating(free), thrusters=[Thruster("body")])


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("<sdf", "a.sdf", "is no XML"),
        ("<sdf version='1.9'/>", "a.sdf", "a.sdf"),
        ("", "a.py", "ends in .sdf or .urdf"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, name: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        multibody_model(tmp_path / name)


def test_wrong_extras_of_a_file_are_refused(tmp_path: Path) -> None:
    text = robot_file("planar_quadrotor").read_text()
    for old, new, message in (
        ('max_thrust="8"', 'max_thrust="much"', "max_thrust='much' must be a number"),
        ('propeller frame="right"', 'propeller where="right"', "lacks 'frame'"),
        ('propeller frame="right"', 'propeller frame="top"', "there is no frame 'top'"),
        (
            "<zermelo:propeller",
            '<zermelo:domain coordinate="z" lower="0" upper="1"/><zermelo:propeller',
            "no coordinate 'z'",
        ),
    ):
        path = tmp_path / "robot.sdf"
        path.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=message):
            multibody_model(path)
