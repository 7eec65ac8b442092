"""The Panda: its decimated meshes, its kinematics, and worlds without memory or noise."""

import subprocess
import sys

import numpy as np
import pytest

from acwm_sim.bullet import GRAVITY, Bullet
from acwm_sim.camera import Camera, Light
from acwm_sim.geometry import rotations
from acwm_sim.meshes import plane
from acwm_sim.panda import HOME, LOWER, MESHES, UPPER, Panda, add_panda, forward, load_mesh
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


def test_forward_kinematics_and_their_jacobian_are_those_of_pybullet(world):
    panda, rng = Panda(world), np.random.default_rng(5)
    for joints in rng.uniform(LOWER, UPPER, (10, 7)):
        for joint, angle in enumerate(joints):
            world.resetJointState(panda.body, joint, angle)
        place, turn, jacobian = forward(joints)
        np.testing.assert_allclose(place, panda.hand_pose[0], atol=1e-6)
        np.testing.assert_allclose(turn, rotations([panda.hand_pose[1]])[0], atol=1e-6)
        for k, nudge in enumerate(1e-6 * np.eye(7)):
            moved, turned, _ = forward(joints + nudge)
            np.testing.assert_allclose(jacobian[:3, k], (moved - place) / 1e-6, atol=1e-5)
            spin = (turned - turn) @ turn.T / 1e-6
            axis = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            np.testing.assert_allclose(jacobian[3:, k], axis, atol=1e-5)


def test_inverse_kinematics_out_of_reach_comes_as_near_as_it_can(world):
    panda = Panda(world)
    angles = panda.solve([1.5, 0.0, 0.333], [1.0, 0.0, 0.0, 0.0])
    assert ((angles >= LOWER) & (angles <= UPPER)).all()
    assert 0.6 < forward(angles)[0][0] < 1.2


def test_inverse_kinematics_finds_the_way_back(world):
    panda, rng = Panda(world), np.random.default_rng(1)
    for _ in range(10):
        place, turn = rng.uniform([0.35, -0.2, 0.1], [0.6, 0.2, 0.4]), [1.0, 0.0, 0.0, 0.0]
        for _ in range(10):
            for joint, angle in enumerate(panda.solve(place, turn)):
                world.resetJointState(panda.body, joint, angle)
        np.testing.assert_allclose(panda.hand_pose[0], place, atol=1e-3)


def test_inverse_kinematics_follows_a_turning_hand_to_a_tenth_of_a_millimetre(world):
    panda, rng = Panda(world), np.random.default_rng(4)
    for place in rng.uniform([0.38, -0.15, 0.04], [0.58, 0.15, 0.3], (10, 3)):
        for step in range(20):
            place = np.clip(
                place + rng.uniform(-0.03, 0.03, 3), [0.35, -0.2, 0.02], [0.6, 0.2, 0.35]
            )
            half = 0.04 * step
            found = panda.solve(place, [np.cos(half), np.sin(half), 0.0, 0.0])
            for joint, angle in enumerate(found):
                world.resetJointState(panda.body, joint, angle)
            if step:  # the first one comes from afar
                np.testing.assert_allclose(panda.hand_pose[0], place, atol=1e-4)
                assert abs(panda.hand_pose[1] @ [np.cos(half), np.sin(half), 0, 0]) > 1 - 1e-6


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


def views(world, meshes):
    """Frames and masks of the arm, bent in several ways, from two sides."""
    rng, panda = np.random.default_rng(3), Panda(world)
    light = Light(direction=(0.55, -0.35, 1.2), softness=0.008)
    cameras = [Camera((1.2, side, 0.7), (0.4, 0, 0.2), fov=38) for side in (-0.5, 0.9)]
    scene = Scene(cameras[0], light, (240, 240), ((0.35, 0, 0.25), 0.75))
    scene.add_mesh(plane(2.5, 10), static=True, gloss=0.0)
    meshes(scene)
    bends = HOME + rng.uniform(-0.3, 0.3, (3, 7))
    for camera in cameras:
        scene.set_camera(camera)
        for bend in bends:
            for joint, angle in enumerate(bend):
                world.resetJointState(panda.body, joint, angle)
            yield scene.render(*panda.poses)


def psnr(squares):
    return -10 * np.log10(squares.mean() / 255**2)


@pytest.mark.ci
def test_the_decimated_arm_looks_like_the_full_one(world):
    decimate_panda = pytest.importorskip("acwm_sim.decimate_panda")
    whole = {name: decimate_panda.decimated(name, 1.0) for name in MESHES}

    def full(scene):
        for number, name in enumerate(parts_drawn()):
            scene.add_mesh(whole[name], instance=2 if number >= 8 else 1, gloss=0.25)

    few = views(world, lambda scene: add_panda(scene, 1, 2))
    for (frame, mask), (reference, reference_mask) in zip(few, views(world, full), strict=True):
        squares = (frame.astype(float) - reference) ** 2
        assert psnr(squares) > 50
        assert psnr(squares[reference_mask > 0]) > 42
        assert (mask != reference_mask).mean() < 2e-4
    kept = sum(len(load_mesh(name).triangles) for name in parts_drawn())
    assert kept < 0.5 * sum(len(whole[name].triangles) for name in parts_drawn())


def parts_drawn():
    return [*MESHES, "finger"]
