"""What a report says of guidance against the same motion without regions, and of how soon something is learned."""

from typing import Any

import pytest
from made_runs import made, of, rows

from dora.agents.reports.run_results import Run

REGIONS, SOON = "What regions gain", "How soon"


def pair(ours: str, theirs: str, seeds: int = 1, **more: Any) -> list[Run]:
    """Runs with regions, then as many without, whose episodes end as the digits say."""
    more |= {"eval_episodes": len(ours)}
    return [
        made(guidance, sum(map(int, won)) / len(won), episodes=of(*map(float, won)), seed=10 + seed, **more)
        for guidance, won in (("affordance", ours), ("grasps", theirs))
        for seed in range(seeds)
    ]


@pytest.mark.parametrize(
    ("ours", "theirs", "points", "verdict"),
    [
        ("1" * 20, "0" * 20, "+100.0 [+100.0, +100.0]", "more"),
        ("0" * 20, "1" * 20, "-100.0 [-100.0, -100.0]", "less"),
        ("1" * 20, "1" * 20, "+0.0 [+0.0, +0.0]", "not told apart"),
        ("10" * 10, "01" * 10, "+0.0 [", "not told apart"),
    ],
)
def test_success_with_regions_is_more_or_less_than_without_or_not_told_apart(ours, theirs, points, verdict):
    (row,) = rows(pair(ours, theirs, seeds=3), REGIONS)
    assert row[:5] == ["DoraJug-v1", "standard", "PPO", "affordance", "3, 3"]
    assert row[5].startswith(points)
    assert row[6:] == [verdict, "-", "-", "-"]


@pytest.mark.parametrize(("ours", "theirs"), [(3, 2), (2, 3), (1, 1)])
def test_few_seeds_give_no_verdict(ours, theirs):
    guided, plain = pair("1" * 20, "0" * 20, seeds=ours)[:ours], pair("1" * 20, "0" * 20, seeds=theirs)[theirs:]
    (row,) = rows([*guided, *plain], REGIONS)
    assert row[5:7] == ["+100.0 [+100.0, +100.0]", f"too few runs: {min(ours, theirs)} of 3 seeds"]


def test_steps_to_a_share_are_read_from_the_curve_where_the_result_lacks_them():
    curve = [{"env_steps": 1000.0 * k, "wall_seconds": 60.0 * k, "success_rate": k / 5} for k in range(1, 6)]
    guided, plain = pair("1100", "1000", curve=curve)
    (row,) = rows([guided, plain, made(seed=11, steps_to_80=6000)], REGIONS)
    assert row[8:] == ["5k (2 of 2)", "4k (1 of 1)"]


def test_their_means_over_training_and_steps_stand_beside_the_final_success():
    curves = [[{"env_steps": 500.0, "wall_seconds": 60.0, "success_rate": share}] for share in (0.9, 0.6)]
    guided = [made(rate=0.9, curve=curves[0], steps_to_80=500_000, seed=seed) for seed in (1, 2)]
    plain = [made("grasps", 0.7, curve=curves[1])]
    (row,) = rows([*guided, *plain], REGIONS)
    assert row[4:] == ["2, 1", "+20.0", "-", "+30.0", "500k (2 of 2)", "never (0 of 1)"]


def test_only_runs_of_the_same_settings_but_for_the_choice_of_candidates_are_compared():
    guided, plain = pair("1100", "1000", task_config={"lift": 0.1, "optimised": False})
    search = made(task_config={"lift": 0.1, "optimised": True}, episodes=of(1, 1, 1, 0), rate=0.75)
    found = rows([guided, search, plain], REGIONS)
    assert [(row[3], row[5].split()[0]) for row in found] == [
        ("affordance, grasp made by hand", "+25.0"),
        ("affordance, grasps of the search", "+50.0"),
    ]
    parts = made(guidance_parts=["reward"], episodes=of(1, 1, 1, 1))
    others = [made(preset="hard"), made(agent="sac"), made(total_steps=9_000), made(env="DoraCube-v1"),
              made(task_config={"lift": 0.2}), made("none"), parts]  # fmt: skip
    assert rows([*others, plain], REGIONS) == []


def test_other_starts_give_a_difference_without_a_verdict():
    guided, plain = pair("1100", "1000")
    (row,) = rows([guided, made("grasps", 0.25, first_seed=6, episodes=plain.episodes)], REGIONS)
    assert row[5:7] == ["+25.0", "-"]


def test_how_soon_is_the_mean_of_the_seeds_that_got_there():
    def curve(*shares: float) -> list[dict[str, float]]:
        return [
            {"env_steps": 25_000.0 * k, "wall_seconds": 90.0 * k, "success_rate": share}
            for k, share in enumerate(shares, 1)
        ]

    quick, slow = made(curve=curve(0.5, 0.9, 0.4)), made(curve=curve(0.2, 0.6, 0.85), seed=11, other_load=0.5)
    (row,) = rows([quick, slow], SOON)
    assert row == ["DoraJug-v1", "standard", "PPO", "affordance", "38k", "62k", "2.2", "3.8", "3.0 (1 of 2)", "†"]
    assert rows([made(curve=curve(0.1))], SOON)[0][4:] == ["never"] * 5 + ["?"]
    assert rows([quick, made(seed=12)], SOON) == []
