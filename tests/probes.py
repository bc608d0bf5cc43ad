"""The loaders of the package, each with small intact files, for `damage.py` and `test_damage.py`."""

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import trimesh
import yaml
from boxes import two_regions
from damage import Loader
from tensordict import TensorDict

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand import link_meshes
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.objects import articulation, catalogue, decomposition
from dora.affordance.objects.articulation import ARTICULATION_FILE, load_mount
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.importing import read_mesh
from dora.affordance.objects.labels import read_labels
from dora.affordance.objects.surface_repair import repair
from dora.affordance.reach.feasibility_table import Grid, ReachTable
from dora.agents.checkpoint import Checkpoint, read_checkpoint
from dora.agents.config import RunConfig, SACConfig
from dora.agents.evaluation.play import load_policy
from dora.agents.learners.learner import make_learner
from dora.agents.learners.replay import Replay
from dora.agents.reports.report import tables, write_report
from dora.agents.reports.run_results import find_runs
from dora.agents.runs.progress_table import ProgressTable
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.stored_results import OF_TABLES, read_result
from dora.digests import SEAL
from dora.live.recordings import Recording, seal
from dora.policies.card import Card
from dora.policies.policy import bundled_files
from dora.robot import loading, mirror, visuals
from dora.robot.build import write_urdf
from dora.tasks.hammer.finger_motion import TURNING_FILE, read_motion

ROOT = Path(__file__).parents[1]
ROBOT = ROOT / "robots" / "diana7_hit"
CONFIG = RunConfig("DoraCube-v1", "ppo", "none", task={"lift": 0.1, "weights": {"lift": 3.0}}, seed=3)
FACES = 12
"""Faces of the box."""
GRID, DIGEST = Grid((0.5, 0.0), (0.0, 0.0), yaws=6), "0" * 64


def write_checkpoint(folder: Path) -> None:
    torch.manual_seed(0)
    tensors = {}
    for name, module in make_learner(CONFIG, 7, 3).policy.modules_by_name.items():
        tensors |= {f"{name}/{key}": value for key, value in module.state_dict().items()}
    Checkpoint(CONFIG, (7, 3), tensors, {"env_steps": 100, "curve": [[1, 2.0, 0.5]]}).write(folder / "a.safetensors")


def load_checkpoint(folder: Path) -> object:
    return load_policy(read_checkpoint(folder / "a.safetensors"), folder)


def replay_of(rows: int) -> Replay:
    replay = Replay(64, 8)
    values = torch.arange(rows, dtype=torch.float32)[:, None]
    replay.extend(TensorDict({"observation": values, "next": {"reward": -values}}, batch_size=[rows]))
    return replay


def load_replay(folder: Path) -> None:
    replay = Replay(64, 8)
    replay.added = 20
    replay.load(folder, "run")
    replay.sample()


def write_candidates(folder: Path) -> None:
    unit = torch.nn.functional.normalize(torch.ones(5, 4), dim=-1)
    found = GraspCandidates(
        "box", torch.zeros(5, 3), unit, torch.eye(3)[[0, 1, 2, 0, 1]], torch.zeros(5, 20), torch.ones(5, 20),
        ("BodyGrasp", "SideGrasp") * 2 + ("BodyGrasp",), contacts=torch.zeros(5, 2, 3),
        contact_finger=torch.tensor([[1, 2]] * 5), contact_map=torch.eye(5, dtype=torch.uint8),
        energy={"distance": torch.rand(5)}, settings=json.dumps({"ranking_steps": 3}),
    )  # fmt: skip
    found.save(folder / "grasps.safetensors")


def load_candidates(folder: Path) -> object:
    return GraspCandidates.load(folder / "grasps.safetensors").ranking_steps


def write_table(folder: Path) -> None:
    reason = torch.zeros(6, 4, dtype=torch.uint8)
    ReachTable(GRID, (1.0, 0.0, 0.0, 0.0), 0.03, reason, DIGEST).save(folder / "reach.safetensors")


def load_table(folder: Path) -> object:
    return ReachTable.load(folder / "reach.safetensors", DIGEST, GRID, 0.03, (1.0, 0.0, 0.0, 0.0))


def write_hulls(folder: Path) -> None:
    decomposition._save(folder / "hulls.safetensors", [trimesh.creation.box((0.1, 0.1, 0.1))])


def load_hulls(folder: Path) -> object:
    return decomposition._load(folder / "hulls.safetensors")


def write_map(folder: Path) -> None:
    AffordanceMap.from_object(two_regions(), 64).save(folder / "map.safetensors")


def load_map(folder: Path) -> object:
    return AffordanceMap.load(folder / "map.safetensors")


def write_config(folder: Path) -> None:
    RunFolder(folder).write_config(CONFIG)


def write_first_config(folder: Path) -> None:
    """Settings of the version without numbers of the task, of the other learner."""
    content = RunConfig("DoraJug-v1", "sac", "affordance", learner=SACConfig())  # pyright: ignore[reportArgumentType]
    RunFolder(folder).write_config(content)
    text = yaml.safe_load((folder / "config.yaml").read_text())
    text = {k: v for k, v in text.items() if k not in ("preset", "guidance_parts", "reward")}
    (folder / "config.yaml").write_text(yaml.safe_dump(text | {"task": {"preset": "hard"}}))


def load_config(folder: Path) -> object:
    from dora.tasks import find_task
    from dora.tasks.env.options import task_config

    config = RunFolder(folder).read_config()
    return task_config(find_task(config.env).CONFIG, config.preset, config.task)


def write_result(folder: Path) -> None:
    result: dict[str, Any] = {
        "env": "Toy-v1", "agent": "ppo", "guidance": "affordance", "seed": 0, "env_steps": 1000, "wall_seconds": 90.0,
        "success_rate": 0.5, "zero_success_rate": 0.5, "penetration_p95_mm": 2.0, "finished": True,
        "eval_episodes": 20, "total_steps": 1000, "first_seed": 5, "preset": "standard", "guidance_parts": ["prior"],
        "raw_success_rate": 0.5, "steps_to_80": None, "stage_rates": {"reach": 0.75},
    }  # fmt: skip
    head = "env_steps,wall_seconds,success_rate,return_mean,penetration_p95_mm,training_success_rate"
    (folder / "curve.csv").write_text(f"{head}\n500,45,0.1,3,2,0.1\n1000,90,0.5,9,nan,0.4\n")
    for name in ("eval.csv", "zero.csv"):
        rows = [f"{k},{k % 2},{k % 2},{k / 100}\n" for k in range(20)]
        (folder / name).write_text("".join(["episode,success,stage/reach,penetration_mm\n", *rows]))
    table = ProgressTable(folder / "progress.csv", ["reach"])
    for step in range(100, 1100, 100):
        table.add({"env_steps": step, "seconds": step / 10, "episodes": 3, "success_rate": 0.5, "return_mean": 1.0})
    RunFolder(folder).write_result(result)


def write_old_result(folder: Path) -> None:
    """A result of a version without digests, which those who read it check all the same."""
    write_result(folder)
    result = json.loads((folder / "result.json").read_text())
    (folder / "result.json").write_text(json.dumps({k: v for k, v in result.items() if k not in (SEAL, OF_TABLES)}))


def load_results(folder: Path) -> object:
    return tables(find_runs(folder))


def load_report(folder: Path) -> object:
    return write_report(folder, folder / "out")


def mark_unfinished(folder: Path) -> object:
    """What a run does that goes on; a result that was changed does not become a good one by that."""
    RunFolder(folder).mark_unfinished()
    return read_result(folder / "result.json")


def write_card(folder: Path) -> None:
    shutil.copy(bundled_files("DoraCube-v1")[1], folder / "card.json")


def load_card(folder: Path) -> object:
    return str(Card.read(folder / "card.json"))


def write_robot_mesh(folder: Path) -> None:
    write_mesh("glb", folder)


def load_robot_mesh(folder: Path) -> object:
    mirror._mesh_image(folder / "thing.glb")
    link_meshes._coloured.cache_clear()
    return link_meshes._coloured(folder / "thing.glb")


def write_robot(folder: Path) -> None:
    for name in ("robot.toml", "robot.urdf"):
        shutil.copy(ROBOT / name, folder)


def load_robot(folder: Path) -> object:
    loading._load.cache_clear()
    return loading.load_robot(folder).collision_bits()


def write_parameters(folder: Path) -> None:
    shutil.copy(ROBOT / "parameters.yaml", folder)


def write_visuals(folder: Path) -> None:
    """A table of meshes with a part of each kind."""
    table = yaml.safe_load((ROBOT / "visuals.yaml").read_text())
    kinds: dict[str, Any] = {}
    for part in (part for parts in table["meshes"].values() for part in parts):
        kinds.setdefault(part["part"], part)
    chosen = {"materials": table["materials"], "meshes": {"one": list(kinds.values())}}
    (folder / "visuals.yaml").write_text(yaml.safe_dump(chosen))


def write_object(folder: Path) -> None:
    write_object_folder(two_regions(), folder / "box")


def load_object(folder: Path) -> object:
    return read_object_folder(folder / "box")


def write_mounted(folder: Path) -> None:
    """The handle of the microwave with what it is mounted on."""
    microwave = catalogue.load_object("microwave")
    write_object_folder(microwave, folder / "microwave")
    assert microwave.folder is not None
    shutil.copy(microwave.folder / ARTICULATION_FILE, folder / "microwave")


def load_mounted(folder: Path) -> Any:
    articulation._read.cache_clear()
    return load_mount(read_object_folder(folder / "microwave"))


def write_turning(folder: Path) -> None:
    hammer = catalogue.load_object("hammer").folder
    assert hammer is not None
    shutil.copy(hammer / TURNING_FILE, folder)


def load_turning(folder: Path) -> Any:
    return read_motion(folder / TURNING_FILE)


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((0.05, 0.06, 0.07))


def write_mesh(ending: str, folder: Path) -> None:
    scene = trimesh.Scene()
    for name, shift in (("one", 0.0), ("two", 0.03)):
        mesh = box()
        mesh.apply_translation((shift, 0, 0))
        scene.add_geometry(mesh, geom_name=name, node_name=name)
    if ending in ("glb", "gltf", "3mf"):
        found = scene.export(file_type=ending)
        for name, content in found.items() if isinstance(found, dict) else [(f"thing.{ending}", found)]:
            assert isinstance(content, bytes)
            (folder / name.replace("model.gltf", "thing.gltf")).write_bytes(content)
    else:
        box().export(folder / f"thing.{ending}")


def load_mesh(ending: str, folder: Path) -> object:
    """All of an import but the decomposition, which takes seconds."""
    mesh, names = read_mesh(folder / f"thing.{ending}")
    return repair(mesh, np.zeros(len(names), np.int64), "thing")


def write_labels(ending: str, folder: Path) -> None:
    path = folder / f"labels.{ending}"
    names = ["handle"] * 5 + ["body"] * 7
    if ending == "npy":
        np.save(path, np.array([0] * 5 + [1] * 7))
    elif ending == "json":
        path.write_text(json.dumps({"labels": ["handle", "body"], "faces": [0] * 5 + [1] * 7, "target": "body"}))
    elif ending == "yaml":
        low, high = {"min": [-1, -1, 0.02], "max": [1, 1, 1]}, {"point": [0, 0, 0], "normal": [0, 0, -1.0]}
        path.write_text(yaml.safe_dump({"regions": {"top": {"box": low}, "low": [{"plane": high}]}, "rest": "body"}))
    else:
        path.write_text("\n".join(names))


def load_labels(ending: str, folder: Path) -> object:
    return read_labels(folder / f"labels.{ending}", np.array(box().triangles_center))


def with_ending(function: Callable[[str, Path], object], ending: str) -> Callable[[Path], object]:
    return functools.partial(function, ending)


def write_recording(folder: Path) -> None:
    """A trajectory file of one short episode, with its index."""
    with h5py.File(folder / "recorded.h5", "w") as file:
        group = file.create_group("traj_0")
        group["actions"] = np.linspace(-1, 1, 78, dtype=np.float32).reshape(3, 26)
        group["env_states/actors/cube"] = np.zeros((4, 13), np.float32)
    info = {"env_id": "dora:DoraCube-v1", "env_kwargs": {"guidance": "none", "preset": "none"}}
    episodes = [{"episode_id": 0, "episode_seed": 5, "control_mode": "wrist_delta_hand_pos"}]
    (folder / "recorded.json").write_text(json.dumps({"env_info": info, "episodes": episodes}))


def write_own_recording(folder: Path) -> None:
    """The same as Dora writes it, with digests."""
    write_recording(folder)
    seal(folder / "recorded.h5")


def load_recording(folder: Path) -> None:
    Recording.open(folder / "recorded.h5").episode(0)


LOADERS: dict[str, Loader] = {
    "checkpoint": Loader(write_checkpoint, load_checkpoint, sealed=True),
    "replay": Loader(lambda folder: replay_of(20).save(folder, "run"), load_replay, sealed=True),
    "candidates": Loader(write_candidates, load_candidates, sealed=True),
    "reach table": Loader(write_table, load_table, sealed=True),
    "hulls in the cache": Loader(write_hulls, load_hulls, sealed=True),
    "affordance map": Loader(write_map, load_map, sealed=True),
    "config.yaml": Loader(write_config, load_config, sealed=True),
    "config.yaml, first": Loader(write_first_config, load_config),
    "result.json": Loader(write_result, load_results, ("result.json",), sealed=True),
    "result.json, marked": Loader(write_result, mark_unfinished, ("result.json",), sealed=True),
    "card": Loader(write_card, load_card, sealed=True),
    "mesh of a robot": Loader(write_robot_mesh, load_robot_mesh),
    "curve.csv": Loader(write_result, load_results, ("curve.csv",), sealed=True),
    "progress.csv": Loader(write_result, load_results, ("progress.csv",), sealed=True),
    "eval.csv": Loader(write_result, load_report, ("eval.csv", "zero.csv"), sealed=True),
    "recording": Loader(write_own_recording, load_recording, sealed=True),
    "recording, others": Loader(write_recording, load_recording),
    "report": Loader(write_result, load_report, ("*.json", "*.csv"), sealed=True),
    "robot.toml": Loader(write_robot, load_robot, ("robot.toml",)),
    "robot.urdf": Loader(write_robot, load_robot, ("robot.urdf",)),
    "parameters.yaml": Loader(write_parameters, write_urdf, ("parameters.yaml",)),
    "visuals.yaml": Loader(write_visuals, visuals.write_meshes, ("visuals.yaml",)),
    "object.toml": Loader(write_object, load_object, ("object.toml",)),
    "articulation.toml": Loader(write_mounted, load_mounted, ("articulation.toml",)),
    "turning.toml": Loader(write_turning, load_turning, ("turning.toml",)),
    "object meshes": Loader(write_object, load_object, ("*.ply",)),
    **{
        f"mesh .{end}": Loader(with_ending(write_mesh, end), with_ending(load_mesh, end))
        for end in ("3mf", "glb", "gltf", "obj", "off", "ply", "stl")
    },
    **{
        f"labels .{end}": Loader(with_ending(write_labels, end), with_ending(load_labels, end))
        for end in ("json", "npy", "txt", "yaml")
    },
}
"""Every loader by its name."""
