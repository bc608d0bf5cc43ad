"""The beginning of episodes: all random numbers are drawn here, and everything gets its first state from them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from torch import Tensor

from dora.arguments import checked_rows, checked_seeds
from dora.geometry.rotations import rotation_angle
from dora.sim.batch.resets import START, check_rebuilding, checked_options
from dora.tasks.env.state import IN_PLACE, check_start

SOWN = "sown"
"""Option of a partial reset: the seeds that its environments have got already."""
SCALE_DRAW = 256
"""Which number of an environment's stream is its size [1]: episodes begin with the same numbers, and use fewer."""


def requested(env: Any, seed: Any, options: Any) -> tuple[int | list[int] | None, dict[str, Any]]:
    """Seeds and options of a reset in the form that ManiSkill takes; in a partial one the seeds are sown already.

    Args:
        env: the environment.
        seed: one, or one for each environment that is reset.
        options: as of `DoraEnv.reset`, or None.

    Raises:
        InputError: as `dora.arguments.checked_seeds`, `dora.sim.batch.resets.checked_options` and `check_start`.
    """
    given, options = options, checked_options(options, env.num_envs, env.device)
    rows = options.get("env_idx", range(env.num_envs))
    seeds = checked_seeds(seed, len(rows))
    if "env_idx" in options and isinstance(seeds, list) and len(seeds) == len(rows):
        order = checked_rows(given["env_idx"], env.num_envs).argsort().tolist()
        seeds = [seeds[k] for k in order]
    check_rebuilding(env, options)
    if START in options and len(rows) > 0:
        check_start(env, options[START], options.get("env_idx", torch.arange(env.num_envs, device=env.device)))
    if len(rows) < env.num_envs:
        if seeds is not None and len(rows) > 0:
            options[SOWN] = [seeds] if isinstance(seeds, int) else seeds
            _sow(env, options["env_idx"].tolist(), options[SOWN])
        return None, options
    if seeds is not None and START not in options:
        options["reconfigure"] = True
    return seeds, options


def _sow(env: Any, rows: list[int], seeds: list[int]) -> None:
    """Gives some environments random streams of their own seeds; one seed gives further ones, as in ManiSkill."""
    if len(seeds) < len(rows):
        more = BatchedRNG.from_seeds(seeds).rngs[0].randint(2**31, size=len(rows) - 1)
        seeds = [*seeds, *more.tolist()]
    env._main_seed, env._episode_seed = np.array(env._main_seed), env._episode_seed.copy()
    for streams in (env._batched_main_rng, env._batched_episode_rng):
        streams[rows] = BatchedRNG.from_seeds(seeds).rngs
    env._main_seed[rows] = env._episode_seed[rows] = seeds
    env._main_rng, env._episode_rng = env._batched_main_rng[0], env._batched_episode_rng[0]


def drawn_sizes(env: Any, objects: Sequence[str]) -> Float[Tensor, "n objects"]:
    """Sizes of a new scene's objects relative to their nominal ones, one draw from each environment's own stream; 1 for
    objects that the task makes in one size only."""
    draws = np.asarray(env._batched_episode_rng.uniform(size=(SCALE_DRAW + len(objects) - 1,)))
    share = 2 * draws.reshape(env.num_envs, -1)[:, SCALE_DRAW - 1 :] - 1
    share[:, [name in env.task.ONE_SIZE for name in objects]] = 0.0
    return torch.tensor(1 + env.config.randomisation.size * share, dtype=torch.float32, device=env.device)


def begin_episodes(env: Any, rows: Int[Tensor, " b"], options: Mapping[str, Any]) -> None:
    """Starts new episodes in the environments `rows`: robots, objects, memory, stages, noise, candidates.

    Args:
        env: the environment.
        rows: environments.
        options: of the reset. With `IN_PLACE` robots and objects stay where they are.
    """
    if SOWN in options and env._enhanced_determinism:  # ManiSkill has drawn seeds of episodes from those since
        _sow(env, rows.tolist(), options[SOWN])
    place, mass, friction, error, key = _draws(env, rows)
    if options.get(IN_PLACE):
        env.task.begin_in_place(env.task_scene, rows)
    else:
        for arm in env.arms.values():
            arm.agent.robot.set_qpos(arm.home_joints().expand(len(rows), -1))
            arm.rest(rows)
        env.task.place(env.task_scene, rows, place if env.chosen_start is None else env.chosen_start(place))
    env.memory.begin(rows, {name: body.pose.p[rows] for name, body in env.objects.items()})
    randomisation = env.config.randomisation
    low, high = randomisation.friction
    for k, name in enumerate(env.objects):
        nominal = env.task_scene.nominal_masses(name)[rows]
        env.memory.objects[name].write(
            rows, mass=env.task.masses(name, nominal, mass[:, k]), friction=low + (high - low) * friction[:, k]
        )
    env.task_scene.apply_properties(env.memory, rows)
    env.machine.reset(rows)
    env.perturbations.begin(rows, key[:, 0])
    env.past.begin(rows)
    errors = (2 * error - 1).split([choice.error_draws for choice in env.arms.choices.values()], -1)
    for arm, e in zip(env.arms.values(), errors, strict=True):
        pose = env.objects[arm.spec.object].pose
        p, q = pose.p[rows], pose.q[rows]
        e = env.perturbations.misplace(arm.name, rows, e, arm.guide.choice.error_scale)
        arm.choose(rows, p, q, env.task.reachable(arm, rows, p, q), e, randomisation, env.narrow.get(arm.name))


def start_numbers(env: Any) -> dict[str, Float[Tensor, " n"]]:
    """How the running episodes began, as far as it was drawn at random: of each object `size` relative to the nominal
    one, `mass` [kg] and `friction`; of each arm the distance of its first candidate from what the set holds, or of a
    misplaced object's measured pose from the true one, as `candidate_error_mm` and `candidate_error_deg`. Names end in
    `_<object>` or `_<arm>` where there are several."""
    found: dict[str, Tensor] = {}
    for k, name in enumerate(env.objects):
        end, drawn = f"_{name}" if len(env.objects) > 1 else "", env.memory.objects[name]
        found |= {f"size{end}": env.scale[:, k], f"mass{end}": drawn.mass, f"friction{end}": drawn.friction}
    for name, choice in env.arms.choices.items():
        end, held, chosen = f"_{name}" if len(env.arms) > 1 else "", choice.candidates, choice.buffers.chosen.long()
        shift, tilt = (part.norm(dim=-1) for part in env.perturbations.bias(name).split(3, -1))
        away = (choice.buffers.position[:, 0] - held.position[chosen]).norm(dim=-1) + shift
        turn = rotation_angle(choice.buffers.quaternion[:, 0], held.quaternion[chosen]) + tilt
        found |= {f"candidate_error_mm{end}": 1e3 * away, f"candidate_error_deg{end}": turn.rad2deg()}
    return found


def _draws(env: Any, rows: Tensor) -> tuple[Tensor, ...]:
    """Uniform numbers of new episodes (b, ...): place, masses, friction, candidates' errors, key of the noise.

    One draw per environment from its own stream: neither num_envs nor the others' resets change it.
    """
    errors = sum(choice.error_draws for choice in env.arms.choices.values())
    parts = [env.task.DRAWS, len(env.objects), len(env.objects), errors, 1]
    assert sum(parts) < SCALE_DRAW
    draws = np.asarray(env._batched_episode_rng[rows.cpu().numpy()].uniform(size=(sum(parts),)))
    u = torch.as_tensor(draws, dtype=torch.float32, device=env.device).reshape(len(rows), sum(parts))
    return u.split(parts, -1)
