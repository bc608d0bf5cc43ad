"""Values that every reader of settings refuses: huge integers, and keys that stand twice in a mapping."""

import time
from pathlib import Path

import numpy as np
import pytest
from probes import load_config, write_config, write_labels, write_mounted, write_object, write_robot
from refusals import refused, written

from dora.affordance.objects.articulation import load_mount
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.labels import read_labels
from dora.errors import shown
from dora.reading import parse_json, read_toml, read_yaml
from dora.robot import load_robot

HUGE = f"0x{'f' * 6000}"
"""An integer of more digits than Python prints."""


def test_base_60_is_text(tmp_path: Path):
    """It would take quadratic time."""
    long, start = ":".join("1" * 80_000), time.perf_counter()
    text = f'a: 1:30\nb: -1:30.5\nc: {long}\nd: !!int "{long}"\ne: !!float "{long}.5"\nf: 0x1f\ng: 1_0\nh: -1.5e+3\n'
    found = read_yaml(written(tmp_path / "a.yaml", text), "file")
    assert time.perf_counter() - start < 1.0
    assert list(found.values()) == ["1:30", "-1:30.5", long, long, f"{long}.5", 31, 10, -1500.0]


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("a: 1\nb: 2\na: 3", "line 3 has the key 'a' again"),
        ("a: 1\n'a': 3", "'a'"),
        ("x: {y: [{z: 1, z: 1}]}", "'z'"),
        ("1: a\n0x1: b", "1"),
        ("{true: a, yes: b}", "True"),
        ("? {a: 1, a: 2}\n: 1", "'a'"),
        ("a: &x {b: 1, b: 2}\nc: *x", "'b'"),
        ("a: &x {b: 1}\nc: {<<: *x, d: 1, d: 2}", "'d'"),
    ],
)
def test_a_key_twice_in_yaml_is_refused(tmp_path: Path, text: str, key: str):
    with refused(key):
        read_yaml(written(tmp_path / "a.yaml", text), "file")


def test_keys_may_repeat_those_that_are_merged(tmp_path: Path):
    text = "a: &a {x: 1}\nb: &b {<<: *a, x: 2}\nc: {x: 3, <<: *b}\nd: [*b, *b]\ne: &e {<<: [*a, *b], y: 1}"
    found = read_yaml(written(tmp_path / "a.yaml", text), "file")
    assert found == {"a": {"x": 1}, "b": {"x": 2}, "c": {"x": 3}, "d": [{"x": 2}] * 2, "e": {"x": 1, "y": 1}}
    assert read_yaml(written(tmp_path / "a.yaml", ""), "file") is None


def test_a_key_twice_in_labels_or_settings_is_refused(tmp_path: Path):
    write_labels("yaml", tmp_path)
    path = tmp_path / "labels.yaml"
    text = path.read_text()
    with refused("labels.yaml .* has the key 'rest' again"):
        read_labels(written(path, f"{text}\nrest: other\n"), np.zeros((12, 3)))
    write_config(tmp_path)
    with refused("config.yaml .* has the key 'seed' again"):
        load_config(written(tmp_path / "config.yaml", f"{(tmp_path / 'config.yaml').read_text()}\nseed: 9\n").parent)


def test_a_key_twice_in_json_is_refused():
    assert parse_json('[{"a": {"b": 1}}, {"a": 1}]', "file") == [{"a": {"b": 1}}, {"a": 1}]
    with refused("file is not valid JSON .a mapping has the key 'b' twice"):
        parse_json('[{"a": {"c": 1, "b": 1, "b": 2}}]', "file")


@pytest.mark.parametrize("key", ["seed", "env", "total_steps", "guidance"])
def test_huge_integers_in_settings_are_refused(tmp_path: Path, key: str):
    write_config(tmp_path)
    path = tmp_path / "config.yaml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith(f"{key}:")]
    with refused("more than 1000 bits"):
        load_config(written(path, "\n".join([*lines, f"{key}: {HUGE}"])).parent)


@pytest.mark.parametrize("text", [f"regions: {{? {HUGE} : 1}}", f"{{regions: {{}}, rest: {HUGE}}}", f"[[-{HUGE}]]"])
def test_huge_integers_in_labels_are_refused(tmp_path: Path, text: str):
    with refused("more than 1000 bits"):
        read_labels(written(tmp_path / "labels.yaml", text), np.zeros((12, 3)))


@pytest.mark.parametrize("key", ["target", "format", "name", "mesh", "mass"])
def test_huge_integers_in_objects_are_refused(tmp_path: Path, key: str):
    write_object(tmp_path)
    _spoil(tmp_path / "box" / "object.toml", key)
    with refused("more than 1000 bits"):
        read_object_folder(tmp_path / "box")


@pytest.mark.parametrize("key", ["urdf", "wrist_link", "tip_radius"])
def test_huge_integers_in_robots_are_refused(tmp_path: Path, key: str):
    write_robot(tmp_path)
    _spoil(tmp_path / "robot.toml", key)
    with refused("more than 1000 bits"):
        load_robot(tmp_path)


def test_huge_integers_in_articulations_are_refused(tmp_path: Path):
    write_mounted(tmp_path)
    folder = tmp_path / load_object("microwave").name
    _spoil(folder / "articulation.toml", "format")
    with refused("more than 1000 bits"):
        load_mount(read_object_folder(folder))


def _spoil(path: Path, key: str) -> None:
    """Puts the huge integer in place of the first value of this key."""
    lines = path.read_text().splitlines()
    index = next(i for i, line in enumerate(lines) if line.startswith(f"{key} ="))
    lines[index] = f"{key} = {HUGE}"
    written(path, "\n".join(lines))


def test_the_largest_integers_can_be_printed_and_made_floats(tmp_path: Path):
    found = read_toml(written(tmp_path / "a.toml", f"a = {2**1000 - 1}\nb = [{{c = -{2**1000 - 1}}}]"), "file")
    assert str(float(found["a"])) in str((float(found["a"]), found))
    with refused("more than 1000 bits"):
        read_toml(written(tmp_path / "a.toml", f"b = [{{c = -{2**1000}}}]"), "file")


def test_what_has_no_text_is_shown_by_its_type():
    class Mute:
        def __repr__(self) -> str:
            raise RuntimeError("mute")

    class Number(int):
        def __repr__(self) -> str:
            raise RuntimeError("mute")

    assert shown(10**6000) == "<int>"
    assert shown([1, {"a": 10**6000}, (10**6000,)]) == "[1, {'a': <int>}, (<int>,)]"
    assert "Mute" in shown({1: Mute()})
    assert "Number" in shown(Number(3))
    assert shown({"a": [1, 2.5, None]}) == "{'a': [1, 2.5, None]}"
