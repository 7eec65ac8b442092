"""The Panda: its decimated meshes, its kinematics, and worlds without memory or noise."""

import subprocess
import sys

import numpy as np
import pytest

from acwm_sim.bullet import GRAVITY, Bullet
from acwm_sim.camera import Camera, Light
from acwm_sim.meshes import plane
from acwm_sim.panda import HOME, LOWER, UPPER, Panda, add_panda
from acwm_sim.panda_mesh import MESHES, load
from acwm_sim.rotations import rotations
from acwm_sim.scene import Scene

# Franka's Denavit–Hartenberg parameters (Craig's convention): a, d, α of each joint and the flange.
DH = [
    (0, 0.333, 0),
    (0, 0, -np.pi / 2),
    (0, 0.316, np.pi / 2),
    (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0, 0, np.pi / 2),
    (0.088, 0, np.pi / 2),
]
FLANGE_TO_GRASP = 0.107 + 0.105  # metres along z; the hand is turned by −45° about it


@pytest.fixture
def world():
    made = Bullet(1 / 240)
    yield made
    made.close()


def grasp_point(joints):
    pose = np.eye(4)
    for (a, d, alpha), q in zip(DH, joints, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        pose = pose @ [
            [c, -s, 0, a],
            [s * ca, c * ca, -sa, -sa * d],
            [s * sa, c * sa, ca, ca * d],
            [0, 0, 0, 1],
        ]
    return (pose @ [0, 0, FLANGE_TO_GRASP, 1])[:3]


def test_the_hand_is_where_the_published_parameters_put_it(world):
    panda, rng = Panda(world), np.random.default_rng(0)
    for joints in (HOME, *rng.uniform(LOWER, UPPER, (20, 7))):
        for joint, angle in enumerate(joints):
            world.resetJointState(panda.body, joint, angle)
        np.testing.assert_allclose(panda.hand_pose[0], grasp_point(joints), atol=1e-3)


def test_inverse_kinematics_finds_the_way_back(world):
    panda, rng = Panda(world), np.random.default_rng(1)
    for _ in range(10):
        place, turn = rng.uniform([0.35, -0.2, 0.1], [0.6, 0.2, 0.4]), [1.0, 0.0, 0.0, 0.0]
        for _ in range(10):
            for joint, angle in enumerate(panda.solve(place, turn)):
                world.resetJointState(panda.body, joint, angle)
        np.testing.assert_allclose(panda.hand_pose[0], place, atol=1e-3)


def test_motors_hold_the_arm_against_gravity(world):
    panda = Panda(world)
    panda.drive(HOME)
    for _ in range(240):
        world.stepSimulation()
    np.testing.assert_allclose(panda.joints, HOME, atol=2e-3)


def test_a_world_falls_as_newton_says(world):
    ball = world.createMultiBody(1.0, world.createCollisionShape(2, radius=0.05), -1, [1, 1, 5])
    world.changeDynamics(ball, -1, linearDamping=0)
    for _ in range(120):
        world.stepSimulation()
    velocity = world.getBaseVelocity(ball)[0][2]
    assert velocity == pytest.approx(-GRAVITY * 0.5, rel=1e-6)


def test_rotations_are_those_of_pybullet(world):
    quaternions = np.random.default_rng(2).normal(size=(10, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    expected = [world.getMatrixFromQuaternion(q.tolist()) for q in quaternions]
    np.testing.assert_allclose(rotations(quaternions), np.reshape(expected, (10, 3, 3)), atol=1e-12)


def test_pybullet_prints_nothing():
    code = "from acwm_sim.bullet import Bullet; Bullet(1 / 240).close(); print('end')"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ran.stdout, ran.stderr) == ("end\n", "")


def view(world, meshes):
    scene = Scene(
        Camera((1.15, -0.65, 0.75), (0.35, 0, 0.2), fov=42), Light(), (240, 240), ((0.3, 0, 0.3), 1)
    )
    scene.add_mesh(plane(2.5, 10), static=True, gloss=0.0)
    meshes(scene)
    return scene.render(*Panda(world).poses)


def test_the_decimated_arm_looks_like_the_full_one(world):
    decimate_panda = pytest.importorskip("acwm_sim.decimate_panda")

    def full(scene):
        parts = [*MESHES, "finger"]
        for number, name in enumerate(parts):
            mesh = decimate_panda.decimated(name, 1.0)
            scene.add_mesh(mesh, instance=2 if number >= 8 else 1, gloss=0.25)

    frame, mask = view(world, lambda scene: add_panda(scene, 1, 2))
    reference, reference_mask = view(world, full)
    squares = (frame.astype(float) - reference) ** 2
    assert -10 * np.log10(squares.mean() / 255**2) > 50
    assert -10 * np.log10(squares[reference_mask > 0].mean() / 255**2) > 45
    assert (mask != reference_mask).mean() < 2e-4
    kept = sum(len(load(name).triangles) for name in parts_drawn())
    assert kept < 0.5 * sum(len(decimate_panda.decimated(n, 1.0).triangles) for n in parts_drawn())


def parts_drawn():
    return [*MESHES, "finger"]
