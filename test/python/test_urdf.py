"""The cell's URDF against the robots' published kinematics."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
ROBOT = ElementTree.parse(ROOT / "urdf" / "cell.urdf").getroot()
UR5_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
# d, a, alpha: ros-industrial/universal_robot, ur_description/config/ur5
DH = (
    (0.089159, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.39225, 0.0),
    (0.10915, 0.0, np.pi / 2),
    (0.09465, 0.0, -np.pi / 2),
    (0.0823, 0.0, 0.0),
)


def transform(xyz=(0.0, 0.0, 0.0), rotation=None):
    t = np.eye(4)
    t[:3, 3] = xyz
    if rotation is not None:
        t[:3, :3] = rotation.as_matrix()
    return t


def numbers(text):
    return np.array([float(v) for v in text.split()])


def link_frames(q):
    """Name -> T_base_link of every link; q: joint name -> rad, mimic joints follow."""
    frames = {"base_link": np.eye(4)}
    waiting = ROBOT.findall("joint")
    while waiting:
        ready = [j for j in waiting if j.find("parent").get("link") in frames]
        assert ready, "the URDF is no tree below base_link"
        for joint in ready:
            origin = joint.find("origin")
            rpy = Rotation.from_euler("xyz", numbers(origin.get("rpy")))
            frame = frames[joint.find("parent").get("link")]
            frame = frame @ transform(numbers(origin.get("xyz")), rpy)
            if joint.get("type") == "revolute":
                mimic = joint.find("mimic")
                if mimic is None:
                    angle = q.get(joint.get("name"), 0.0)
                else:
                    angle = float(mimic.get("multiplier")) * q.get(mimic.get("joint"), 0.0)
                axis = numbers(joint.find("axis").get("xyz"))
                frame = frame @ transform(rotation=Rotation.from_rotvec(angle * axis))
            frames[joint.find("child").get("link")] = frame
            waiting.remove(joint)
    return frames


def dh(d, a, alpha, theta):
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    )


def test_tool0_is_the_dh_model_turned_by_pi():
    rng = np.random.default_rng(0)
    for q in rng.uniform(-np.pi, np.pi, (20, 6)):
        expected = transform(rotation=Rotation.from_euler("z", np.pi))
        for row, theta in zip(DH, q, strict=True):
            expected = expected @ dh(*row, theta)
        actual = link_frames(dict(zip(UR5_JOINTS, q, strict=True)))["tool0"]
        np.testing.assert_allclose(actual, expected, atol=1e-12)


@pytest.mark.parametrize("q", np.linspace(0.0, 0.8, 5))
def test_pads_close_along_tool0_x_and_stay_parallel(q):
    frames = link_frames({"finger_joint": q})
    T_tool0_base = np.linalg.inv(frames["tool0"])
    left = T_tool0_base @ frames["left_inner_finger_pad"]
    right = T_tool0_base @ frames["right_inner_finger_pad"]
    thickness = 0.00635
    gap = abs(left[0, 3] - right[0, 3]) - thickness
    assert gap == pytest.approx(2 * (0.00541 + 0.05712 * np.sin(0.7185 - q)), abs=2e-5)
    # The midpoint of the pads moves along tool0's z only.
    np.testing.assert_allclose((left + right)[:2, 3], 0.0, atol=1e-12)
    assert left[2, 3] == pytest.approx(right[2, 3], abs=1e-12)
    # The pads' thin side (their y axis) faces the other pad.
    for pad in (left, right):
        np.testing.assert_allclose(np.abs(pad[:3, 1]), [1, 0, 0], atol=1e-12)


def test_pad_centre_rises_while_closing():
    heights = []
    for q in (0.0, 0.8):
        frames = link_frames({"finger_joint": q})
        heights.append((np.linalg.inv(frames["tool0"]) @ frames["left_inner_finger_pad"])[2, 3])
    assert heights == pytest.approx([0.1303, 0.1443], abs=1e-4)


def test_limits_and_masses_are_the_makers():
    limits = {j.get("name"): j.find("limit") for j in ROBOT.findall("joint")}
    efforts = [float(limits[name].get("effort")) for name in UR5_JOINTS]
    assert efforts == [150, 150, 150, 28, 28, 28]
    for name in UR5_JOINTS:
        assert float(limits[name].get("velocity")) == pytest.approx(np.pi)
        assert float(limits[name].get("upper")) == pytest.approx(
            np.pi if name == "elbow_joint" else 2 * np.pi
        )
    mass = {
        link.get("name"): float(link.find("inertial/mass").get("value"))
        for link in ROBOT.findall("link")
        if link.find("inertial") is not None
    }
    gripper = sum(m for name, m in mass.items() if name.startswith(("robotiq", "left", "right")))
    assert gripper == pytest.approx(0.92, abs=1e-4)
    arm = [mass[name] for name in mass if not name.startswith(("robotiq", "left", "right"))]
    assert arm == [4.0, 3.7, 8.393, 2.275, 1.219, 1.219, 0.1879]


def test_inertias_are_those_of_real_bodies():
    for link in ROBOT.findall("link"):
        inertia = link.find("inertial/inertia")
        if inertia is None:
            continue
        i = {k: float(v) for k, v in inertia.items()}
        matrix = np.array(
            [
                [i["ixx"], i["ixy"], i["ixz"]],
                [i["ixy"], i["iyy"], i["iyz"]],
                [i["ixz"], i["iyz"], i["izz"]],
            ]
        )
        a, b, c = np.linalg.eigvalsh(matrix)
        assert a > 0 and a + b >= c * (1 - 1e-3), link.get("name")


def collision_body(element):
    """The trimesh of a <collision>, in its link's frame."""
    import trimesh

    shape, origin = element.find("geometry")[0], element.find("origin")
    if shape.tag == "mesh":
        body = trimesh.load(ROOT / shape.get("filename").removeprefix("package://iwgnet_grasp/"))
    else:
        body = trimesh.creation.box(numbers(shape.get("size")))
    if origin is not None:
        rpy = Rotation.from_euler("xyz", numbers(origin.get("rpy")))
        body.apply_transform(transform(numbers(origin.get("xyz")), rpy))
    return body


def test_meshes_lie_where_the_links_are():
    """Every mesh the URDF names exists, in metres; its geometry spans the joint to the next one."""
    trimesh = pytest.importorskip("trimesh")
    if not (ROOT / "assets" / "robot").is_dir():
        pytest.skip("no assets: run scripts/setup")
    for mesh in ROBOT.iter("mesh"):
        path = ROOT / mesh.get("filename").removeprefix("package://iwgnet_grasp/")
        assert path.is_file(), path
        if path.suffix == ".stl":
            assert 0.01 < trimesh.load(path).extents.max() < 0.6, path

    def collision(name):
        link = next(item for item in ROBOT.findall("link") if item.get("name") == name)
        return collision_body(link.find("collision"))

    # Upper arm and forearm reach from their joint along -x to the next one.
    for name, length in (("upper_arm_link", 0.425), ("forearm_link", 0.39225)):
        low, high = collision(name).bounds
        assert -0.07 - length < low[0] < -length and 0.0 < high[0] < 0.07, name
    # The last wrist ends at the flange, where the gripper begins.
    assert collision("wrist_3_link").bounds[1][2] == pytest.approx(0.0, abs=1e-3)
    # The inner finger holds the pad: it ends behind the pad's face and short of its tip.
    low, high = collision("left_inner_finger").bounds
    assert low[1] > -0.0220203 - 0.00635 / 2 and high[2] < 0.03242 + 0.0375 / 2


def gripper_surface(finger_joint):
    """(n, 3) points of the gripper's collision meshes in tool0, and the gap between the pads."""
    trimesh = pytest.importorskip("trimesh")
    frames = link_frames({"finger_joint": finger_joint})
    surface, gap = [], 0.0
    for link in ROBOT.findall("link"):
        name = link.get("name")
        if not name.startswith(("robotiq", "left", "right")):
            continue
        T = np.linalg.inv(frames["tool0"]) @ frames[name]
        for collision in link.findall("collision"):
            body = collision_body(collision).apply_transform(T)
            points, _ = trimesh.sample.sample_surface(body, 3000, seed=0)
            surface.append(points)
            if name == "left_inner_finger_pad":
                gap = 2 * np.abs(points[:, 0]).min()
    return np.concatenate(surface), gap


@pytest.mark.parametrize("finger_joint", [0.0, 0.2, 0.4, 0.6, 0.7])
def test_the_gripper_hangs_over_no_more_than_the_grasping_config_says(finger_joint):
    if not (ROOT / "assets" / "robot").is_dir():
        pytest.skip("no assets: run scripts/setup")
    pose = yaml.safe_load((ROOT / "config" / "grasping.yaml").read_text())["pose"]
    surface, gap = gripper_surface(finger_joint)
    assert 0.01 < gap < 0.09
    along, across, z = np.abs(surface[:, 0]), np.abs(surface[:, 1]), surface[:, 2]
    slack = pose["floor_clearance"]  # m: what the config leaves free in any case
    above_tips = z.max() - z + slack
    covered = z <= pose["palm"]["reach"]  # whatever is wider up there is the arm's business
    for body in pose["finger_bodies"]:
        half = body["along"][0] + body["along"][1] * gap
        inside = (along <= half + slack) & (across <= body["across"] + slack)
        covered |= inside & (above_tips >= body["above_tips"])
    # The fingers: their outline over the pads' width and some play.
    outline = np.array([[pose["finger_thickness"], 0.0], *pose["finger_outline"]])
    outwards = along - gap / 2
    covered |= (
        (outwards <= outline[-1, 0] + slack)
        & (across <= 0.011 + pose["side_clearance"])
        & (above_tips >= np.interp(outwards, *outline.T))
    )
    assert covered.all(), surface[~covered]
