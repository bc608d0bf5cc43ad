"""Values of a URDF that no robot has are refused when it is read, not in the simulator."""

from pathlib import Path

import pytest
from refusals import refused, written

from dora.robot.urdf import read_urdf

INERTIA = {"ixx": 2.0, "ixy": 0.0, "ixz": 0.0, "iyy": 2.0, "iyz": 0.0, "izz": 3.0}
"""Of a plate [kg m^2]."""


def inertial(mass: object = 1.0, origin: str = '<origin xyz="0 0 0"/>', **moments: object) -> str:
    values = " ".join(f'{key}="{value}"' for key, value in (INERTIA | moments).items())
    return f'<inertial>{origin}<mass value="{mass}"/><inertia {values}/></inertial>'


def of_link(content: str) -> str:
    return f'<robot name="a"><link name="l">{content}</link></robot>'


def visual(geometry: str, rest: str = "") -> str:
    return of_link(f"<visual>{rest}<geometry>{geometry}</geometry></visual>")


def collision(geometry: str, rest: str = "") -> str:
    return of_link(f"<collision>{rest}<geometry>{geometry}</geometry></collision>")


def jointed(content: str, kind: str = "revolute") -> str:
    limit = '<limit lower="0" upper="1" velocity="1" effort="1"/>'
    joint = f'<joint name="j" type="{kind}"><parent link="l"/><child link="m"/>{limit}{content}</joint>'
    return f'<robot name="a"><link name="l"/><link name="m"/>{joint}</robot>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (of_link(inertial("abc")), "link 'l': .*'abc'"),
        (of_link(inertial("nan")), "not finite"),
        (of_link(inertial("1_0")), "'1_0' is no number"),
        (of_link(inertial("\uff11")), "is no number"),
        (of_link(inertial("1 2")), "needs one number"),
        (of_link(inertial("")), "needs one number"),
        (of_link(inertial(-5)), "a mass of -5 kg"),
        (of_link(inertial(0)), "a mass of 0 kg"),
        (of_link(inertial(1e-40)), "a mass of 1e-40 kg"),
        (of_link(inertial(1e8)), "a mass of 1e[+]08 kg"),
        (of_link(inertial().replace("ixx", "xx")), "no attribute 'ixx'"),
        (of_link(inertial(ixx="x")), "'ixx' of a <inertia>"),
        (of_link(inertial(ixx=-2)), "no body has"),
        (of_link(inertial(ixx=0, iyy=0, izz=0)), "no body has"),
        (of_link(inertial(izz=4.5)), "no body has"),
        (of_link(inertial(ixy=2.5)), "no body has"),
        (of_link(inertial(ixx=1e-40, iyy=1e-40, izz=1e-40)), "no body has"),
        (of_link(inertial(izz="inf")), "not finite"),
        (of_link(inertial(origin='<origin xyz="0 0"/>')), "needs three numbers"),
        (of_link(inertial(origin='<origin rpy="0 0 nan"/>')), "not finite"),
        (of_link(inertial(origin='<origin xyz="0 0 1e8"/>')), "farther away than 1000 m"),
        (of_link("<inertial/>"), "<inertial> has no <mass>"),
        (of_link('<inertial><mass value="1"/></inertial>'), "<inertial> has no <inertia>"),
        (of_link("<visual/>"), "<visual> has no <geometry>"),
        (visual(""), "<visual> has none of box"),
        (visual("<ball/>"), "<visual> has none of box"),
        (visual("<box/>"), "no attribute 'size'"),
        (visual('<box size="1 1"/>'), "needs three numbers"),
        (visual('<box size="1 1 0"/>'), "not positive"),
        (visual('<sphere radius="-1"/>'), "not positive"),
        (visual('<sphere radius="nan"/>'), "not finite"),
        (visual('<sphere radius="1e-30"/>'), "not from 1e-06 to 10 m"),
        (visual('<cylinder radius="1"/>'), "no attribute 'length'"),
        (visual('<capsule radius="1" length="1e7"/>'), "not from 1e-06 to 10 m"),
        (visual("<mesh/>"), "no attribute 'filename'"),
        (visual('<mesh filename=""/>'), "names no file"),
        (visual('<mesh filename="a.glb" scale="1"/>'), "needs three numbers"),
        (visual('<mesh filename="a.glb" scale="1 0 1"/>'), "scale of a <mesh>"),
        (visual('<box size="1 1 1"/>', '<origin xyz="a b c"/>'), "'xyz' of a <origin>"),
        (visual('<box size="1 1 1"/>', "<material/>"), "<material> has no attribute 'name'"),
        (visual('<box size="1 1 1"/>', '<material name="m"><color rgba="1 1"/></material>'), "needs 4 numbers"),
        (visual('<box size="1 1 1"/>', '<material name="m"><texture/></material>'), "no attribute 'filename'"),
        ('<robot name="a"><material/><link name="l"/></robot>', "<material> has no attribute 'name'"),
        (collision('<box size="1 1 1e-9"/>'), "not from 0.0001 to 10 m"),
        (collision('<cylinder radius=".0765" length="1e8"/>'), "not from 0.0001 to 10 m"),
        (collision('<sphere radius="1e-9"/>'), "not from 0.0001 to 10 m"),
        (collision('<sphere radius="1"/>', '<origin xyz="0 1e6 0"/>'), "farther away than 1000 m"),
        (jointed('<origin xyz="0 -1e6 0"/>'), "farther away than 1000 m"),
        (jointed('<axis xyz="0 0 1e-5"/>'), "has no direction"),
        (jointed('<dynamics damping="-1"/>'), "negative damping or friction"),
        (jointed('<dynamics friction="nan"/>'), "not finite"),
        ('<?xml version="1.0" encoding="ISO-8859-1"?><!-- ü --><robot name="a"/>'.encode("latin-1"), "no UTF-8 text"),
    ],
)
def test_values_that_no_robot_has_are_refused(tmp_path: Path, text: str | bytes, words: str):
    with refused(words):
        read_urdf(written(tmp_path / "a.urdf", text))


@pytest.mark.parametrize(
    "text",
    [
        of_link(inertial()),
        of_link(inertial(izz=4.1)),
        of_link(inertial(2e-5, ixx=2e-9, iyy=2e-9, izz=3e-9)),
        of_link(inertial(0, ixx=0, iyy=0, izz=0)),
        of_link(inertial(origin="")),
        visual('<box size="1 1 1e-5"/>', '<material name="m"><color rgba="1 1 1 1"/></material>'),
        visual('<mesh filename="a.glb" scale="1 -1 1"/>'),
        visual('<capsule radius="1" length="1"/>'),
        collision('<box size="1e-4 10 10"/>'),
        jointed('<axis xyz="0 0 2"/><dynamics damping="0.1" friction="0"/>'),
        jointed("<dynamics/>", "continuous"),
    ],
)
def test_values_that_a_robot_may_have_are_read(tmp_path: Path, text: str):
    assert read_urdf(written(tmp_path / "a.urdf", text)).root == "l"
