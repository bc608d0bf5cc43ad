"""What an object is mounted on: its file, and the door of the microwave in the simulator."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env

from dora.affordance.objects.articulation import ARTICULATION_FILE, Mount, load_mount
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.errors import InputError
from dora.sim.hinged import HingedObject
from dora.sim.substeps import watch_physics

MICROWAVE = load_mount(load_object("microwave"))
"""The microwave around its handle."""
BACKENDS = {"physx_cpu": 1, "physx_cpu_batch": 3}
"""Back ends with numbers of environments."""


@register_env("DoorAlone-v0", max_episode_steps=1000)
class DoorAlone(BaseEnv):
    """A microwave, with a robot far away; a force pulls at the handle, across the door."""

    SUPPORTED_ROBOTS = ["panda_stick"]  # noqa: RUF012 (ManiSkill's)
    pull: Any = 0.0
    """Force on the handle, one number or one for each environment [N]."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, robot_uids="panda_stick", **kwargs)

    def _load_agent(self, options: dict, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose([-3.0, 0.0, 0.0]))

    def _load_scene(self, options: dict) -> None:
        self.oven = HingedObject(self.scene, load_object("microwave"), MICROWAVE)
        watch_physics(self.scene, self._pull)

    def _pull(self, i: int) -> None:
        body = self.oven.link._bodies[i]
        force = np.broadcast_to(self.pull, self.num_envs)[i]
        away = body.entity_pose.to_transformation_matrix()[:3, 0]  # +x of the handle points away from the door
        body.add_force_at_point((force * away).astype(np.float32), body.entity_pose.p, "force")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        n, h = len(env_idx), MICROWAVE.hinge
        resistance = (torch.full((n,), x) for x in (h.damping, h.friction, h.latch))
        turn = torch.tensor([[math.cos(0.1), 0.0, 0.0, math.sin(0.1)]]).repeat(n, 1)
        self.oven.begin(env_idx, torch.tensor([[0.7, 0.1, 0.1]]).repeat(n, 1), turn, *resistance)

    def evaluate(self) -> dict:
        return {}

    def _get_obs_extra(self, info: dict) -> dict:
        return {}

    def compute_dense_reward(self, obs: Any, action: Any, info: dict) -> torch.Tensor:
        return torch.zeros(self.num_envs)

    def run(self, seconds: float) -> None:
        """Lets time pass."""
        for _ in range(round(seconds * self.control_freq)):
            self.step(None)


@pytest.fixture(params=BACKENDS)
def door(request: pytest.FixtureRequest):
    env = DoorAlone(
        num_envs=BACKENDS[request.param],
        sim_backend=request.param,
        render_backend="none",
        obs_mode="none",
        reward_mode="none",
    )
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.usefixtures("materials")
class TestDoor:
    def test_ten_newtons_open_it_and_two_do_not(self, door: DoorAlone):
        door.pull = 2.0
        door.run(2.0)
        assert float(door.oven.angle.abs().max()) < 0.01
        door.pull = 10.0
        door.run(2.0)
        assert float(door.oven.angle.min()) > math.radians(60)

    def test_the_latch_holds_until_it_is_overcome(self, door: DoorAlone):
        door.pull = 4.5  # 1.66 N m, of 2.0 N m of latch and friction
        door.run(2.0)
        assert float(door.oven.angle.abs().max()) < MICROWAVE.hinge.latch_angle

    def test_an_open_door_stays_where_it_is_left(self, door: DoorAlone):
        door.pull = 10.0
        while float(door.oven.angle.min()) < 0.8:
            door.run(0.05)
        door.pull = 0.0
        door.run(1.0)
        left = door.oven.angle.clone()
        door.run(3.0)
        assert float((door.oven.angle - left).abs().max()) < 1e-3
        assert float(door.oven.speed.abs().max()) < 1e-3

    def test_the_handle_is_where_the_object_is_on_the_door(self, door: DoorAlone):
        """Closed: half a turn against the microwave, 71 mm before its front plane but for the bar's own distance."""
        pose, body = door.oven.link.pose, door.oven.links["body"].pose
        local = (body.inv() * pose).p[0]
        place = np.array(MICROWAVE.object_link.position) + np.array(MICROWAVE.hinge_link.position)
        np.testing.assert_allclose(local.numpy(), place, atol=1e-5)

    def test_its_state_holds_what_the_simulator_does_not_keep(self, door: DoorAlone):
        rows = torch.arange(door.num_envs)
        state = door.oven.get_state()
        changed = {name: 2 * value for name, value in state.items()}
        door.oven.set_state(changed, rows)
        assert all(torch.equal(door.oven.get_state()[name], value) for name, value in changed.items())
        door.pull = 9.0  # 3.3 N m is not enough for a latch of 3.6 N m
        door.run(1.0)
        assert float(door.oven.angle.abs().max()) < 0.01


@pytest.mark.usefixtures("materials")
def test_every_environment_has_a_door_of_its_own():
    env = DoorAlone(
        num_envs=3, sim_backend="physx_cpu_batch", render_backend="none", obs_mode="none", reward_mode="none"
    )
    env.reset(seed=0)
    env.pull = np.array([0.0, 12.0, 8.0])
    env.run(0.3)
    shut, wide, half = env.oven.angle.tolist()
    assert abs(shut) < 0.01 < half < wide
    env.close()


# ------------------------------------------------------------------------- file


def test_an_object_without_a_mount_is_refused_in_words():
    message = f"the object 'cube' is not mounted on anything: .* no {ARTICULATION_FILE}: write one"
    with pytest.raises(InputError, match=message):
        load_mount(load_object("cube"))


def mounted(folder: Path, change: tuple[str, str]) -> Mount:
    """A mount whose file differs from the microwave's in one place."""
    here = folder / "microwave"
    write_object_folder(load_object("microwave"), here)
    text = (load_object("microwave").folder / ARTICULATION_FILE).read_text()  # pyright: ignore
    assert change[0] in text
    (here / ARTICULATION_FILE).write_text(text.replace(*change, 1))
    return load_mount(read_object_folder(here))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("dora-articulation 1", "dora-articulation 2"), "the format is 'dora-articulation 2'"),
        (('parent = "body"', 'parent = "lid"'), "must have an earlier link as its parent"),
        (('name = "door"', 'name = "body"'), "needs a name of its own"),
        (("axis = [0.0, 0.0, -1.0]", "axis = [0.0, 0.0, -2.0]"), "norm is not 1"),
        (("limits = [0.0, 1.9]", "limits = [1.9, 0.0]"), "limits are not ordered"),
        (("damping = 0.5", "damping = nan"), "not finite"),
        (("damping = 0.5", 'damping = "much"'), "damping"),
        (("damping = 0.5", "dampening = 0.5"), "dampening"),
        (('shape = "box"', 'shape = "torus"'), "has a shape 'torus'"),
        (("size = [0.17, 0.20, 0.05]", "size = [0.17, 0.20]"), "with 2 sizes"),
        (("size = [0.17, 0.20, 0.05]", "size = [0.17, 0.0, 0.05]"), "is not positive"),
        (("mass = 1.0", "mass = 0.0"), "positive mass"),
        (("object = true", "object = false"), "one must be the object"),
        (("[links.hinge]", "[links.hinges]"), "hinges"),
    ],
)
def test_a_damaged_file_ends_in_a_sentence(tmp_path: Path, change: tuple[str, str], message: str):
    with pytest.raises(InputError, match=message) as refused:
        mounted(tmp_path, change)
    assert ARTICULATION_FILE in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_with_another_number_has_another_door(tmp_path: Path):
    assert mounted(tmp_path, ("damping = 0.5", "damping = 0.7")).hinge.damping == 0.7
