"""What is known of a bundled policy: where it comes from, how often it succeeds, and what it fails at."""

from dataclasses import dataclass
from pathlib import Path

from dora.configs import LARGEST, built, check_finite, check_ranges, plain
from dora.digests import SEAL, is_whole, sealed
from dora.errors import InputError
from dora.files import write_json
from dora.reading import read_json
from dora.tables import share_text, text_table

MOST = 100_000
"""Size of a card above which it is not read [bytes]."""
COUNTS = ("seed", "env_steps", "total_steps", "minutes", "first_seed", "overlap_limit_mm", "counted_successes")
"""Figures that are at least 0."""
RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(COUNTS, (0, LARGEST)),
    **dict.fromkeys(("episodes", "training_episodes", "chosen_among"), (1, LARGEST)),
    **dict.fromkeys(("training_success", "success_rate", "zero_success_rate"), (0, 1)),
}  # fmt: skip
"""Lowest and highest value of figures."""
HEADINGS = (
    "task", "agent", "preset", "steps", "seed", "success %", "scripted (zero correction) %", "overlap p95 mm",
    "what it fails at",
)  # fmt: skip
"""Of a table of cards."""


@dataclass(frozen=True, kw_only=True)
class Card:
    """Figures of one policy; all are read or counted by `python -m dora.policies.bundle`, none is typed."""

    env: str
    """Task id."""
    agent: str
    """Learner."""
    guidance: str
    """Guidance that it was trained and evaluated with."""
    preset: str
    """How much the episodes were randomised."""
    seed: int
    """Seed of the run."""
    env_steps: int
    """Environment steps after which this policy was kept."""
    total_steps: int
    """Budget of the run in environment steps."""
    minutes: float
    """Wall time of the run [min]."""
    chosen_among: int
    """Runs of the task among which its evaluation during training chose this one [1]."""
    training_success: float
    """Success rate of that evaluation."""
    training_episodes: int
    """Its episodes."""
    success_rate: float
    """Success rate on other starts, which neither trained nor chose the policy."""
    success_interval: tuple[float, float]
    """Wilson's 95 % interval of it."""
    zero_success_rate: float | None
    """Success rate of zero correction on the same starts, if it was measured."""
    episodes: int
    """Those starts."""
    first_seed: int
    """Seed of the first of them; the others follow."""
    overlap_p95_mm: float | None
    """95th percentile over these episodes of the largest overlap [mm]."""
    overlap_limit_mm: float
    """Overlap above which an episode is no success [mm]."""
    stage_rates: dict[str, float]
    """Share of these episodes in which each stage was done."""
    counted_successes: int
    """Successes when the failures were counted, in as many episodes of the same starts."""
    failures: dict[str, int]
    """Failed episodes by what went wrong first; together with the successes they are all episodes."""
    run: str
    """Folder of the run, below the folder of results."""
    run_commit: str | None
    """Commit that made its result."""
    commit: str | None
    """Commit that counted the failures and made this card."""
    date: str
    """Day on which it was made."""

    def write(self, path: Path) -> None:
        """Write it as JSON with a digest, atomically."""
        write_json(path, sealed(plain(self)))

    @classmethod
    def read(cls, path: Path) -> "Card":
        """A card as `write` wrote it.

        Raises:
            InputError: if it is missing, too large, has other entries, or figures that cannot be, or was changed.
        """
        content = read_json(path, "card", MOST)
        if not isinstance(content, dict):
            raise InputError(f"{path} is no card of a policy: make it again by python -m dora.policies.bundle.")
        if not is_whole(content):
            raise InputError(f"the card {path} is damaged (its digest differs): run python -m dora.policies.bundle.")
        card = built(cls, {name: value for name, value in content.items() if name != SEAL}, f"the card {path}")
        check_finite(card, f"the card {path}")
        check_ranges(card, RANGES, lambda name: f"{name} of the card {path}")
        return card

    @property
    def failures_text(self) -> str:
        """What it fails at as shares of all episodes, the most frequent first."""
        most = sorted(self.failures.items(), key=lambda item: -item[1])
        found = [f"{cause} {100 * count / self.episodes:.1f} %" for cause, count in most]
        return ", ".join(found) or "nothing in these episodes"

    def row(self) -> list[str]:
        """Cells under `HEADINGS`."""
        zero, overlap = self.zero_success_rate, self.overlap_p95_mm
        return [
            self.env, self.agent.upper(), self.preset, f"{self.env_steps / 1000:.0f}k", str(self.seed),
            share_text(self.success_rate, self.episodes, 100.0, 1), "-" if zero is None else f"{100 * zero:.1f}",
            "-" if overlap is None else f"{overlap:.1f} (limit {self.overlap_limit_mm:g})", self.failures_text,
        ]  # fmt: skip

    def __str__(self) -> str:
        """The card as a table of two columns."""
        row = [*self.row()[:-1], self.failures_text.replace(", ", "\n")]
        rows = [["guidance", self.guidance], *map(list, zip(HEADINGS, row, strict=True))]
        stages = ", ".join(f"{name} {100 * rate:.1f} %" for name, rate in self.stage_rates.items())
        training = f"{self.training_success:.2f} of {self.training_episodes} episodes, best of {self.chosen_among} runs"
        rows += [
            ["starts", f"{self.episodes}, seeds from {self.first_seed}"], ["stages done", stages],
            ["chosen by training", training], ["training", f"{self.minutes:.1f} minutes"],
            ["run", f"{self.run} ({self.run_commit or 'unknown commit'})"],
            ["card made", f"{self.date} ({self.commit or 'unknown commit'})"],
        ]  # fmt: skip
        return text_table(["what", "value"], rows)
