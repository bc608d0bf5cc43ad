"""Confidence intervals of shares of episodes."""

from scipy.stats import binomtest

CONFIDENCE = 0.95
"""Probability with which an interval covers the true share [1]."""


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's interval of a share `hits` / `trials` (E. B. Wilson 1927); (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(hits, trials).proportion_ci(CONFIDENCE, "wilson")
    return float(interval.low), float(interval.high)


def share_text(share: float, trials: int, scale: float = 1.0, digits: int = 3) -> str:
    """A share with its interval, such as "0.875 [0.822, 0.914]"; `scale` 100 gives percent."""
    low, high = wilson(round(share * trials), trials)
    return f"{scale * share:.{digits}f} [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"
