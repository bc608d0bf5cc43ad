"""A dataset of LeRobot is written and read back with pyarrow alone: `python examples/read_dataset.py --out runs/cube`.

Needs pyarrow: `pip install -e '.[datasets]'`. `dora demos` writes the same from the command line.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet

from dora.datasets.episodes import Plan
from dora.datasets.record import record_dataset
from dora.datasets.sources import find_source

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="DoraCube-v1", help="a Dora id")
parser.add_argument("--policy", default="policy", help="scripted, policy, or the path of a checkpoint or run folder")
parser.add_argument("--episodes", type=int, default=2)
parser.add_argument("--out", type=Path, default=Path("runs/cube"), help="folder of the dataset, which must not exist")
args = parser.parse_args()

record_dataset("lerobot", find_source(args.env, args.policy), Plan(args.episodes, seed=1000), args.out)

info = json.loads((args.out / "meta/info.json").read_text())
frames = parquet.read_table(sorted((args.out / "data").rglob("*.parquet")))
print(f"{info['total_episodes']} episodes, {len(frames)} frames at {info['fps']} Hz: {', '.join(frames.column_names)}")

names = info["features"]["action"]["names"]
actions = np.array(frames["action"].to_pylist())  # (frames, a), in [-1, 1]
strongest = int(np.abs(actions).mean(0).argmax())
print(f"{actions.shape[1]} components of the action; {names[strongest]} is the largest on average")

for episode in parquet.read_table(sorted((args.out / "meta/episodes").rglob("*.parquet"))).to_pylist():
    own = frames.slice(episode["dataset_from_index"], episode["length"])
    total = np.sum(own["next.reward"].to_pylist())
    print(f"seed {episode['seed']}: {episode['length']} steps, return {total:.1f}, success {episode['success']}")
