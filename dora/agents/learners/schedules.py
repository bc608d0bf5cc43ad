"""What changes over the course of a run: the pull towards no correction, exploration, and learning rates."""

from dora.agents.config import PPOConfig, SACConfig


def pull(config: PPOConfig | SACConfig, steps: float) -> float:
    """Weight of the squared mean action in the loss of an actor.

    It is `prior`, or falls from there to `prior_last`: prior (prior_last / prior)^(steps / prior_steps).
    A strong pull keeps a new actor at the reference while its critic knows nothing yet; a weak one lets it make large
    corrections where they pay.

    Args:
        config: settings of the learner.
        steps: environment steps that were learned from so far.
    """
    if config.prior_last is None or config.prior == 0:
        return config.prior
    return config.prior * (config.prior_last / config.prior) ** min(steps / config.prior_steps, 1.0)


def rates_left(config: SACConfig, steps: float) -> float:
    """Share of the learning rates of critics and actor.

    It is 1, or falls evenly to `learning_rate_last` at `learning_rate_steps`, from a third of these steps on. By how
    much the noise of single gradient steps moves a policy to and fro in the end is proportional to it.

    Args:
        config: settings of the learner.
        steps: environment steps that were learned from so far.
    """
    if config.learning_rate_last is None:
        return 1.0
    begin = config.learning_rate_steps / 3
    fallen = min(max((steps - begin) / (config.learning_rate_steps - begin), 0.0), 1.0)
    return 1.0 + fallen * (config.learning_rate_last - 1.0)


def loudest(config: PPOConfig, steps: float) -> float:
    """Ceiling of the logarithm of the exploration noise, a standard deviation in units of the action's half range.

    It is 0, the half range itself, or falls evenly from `log_std` to `log_std_last` at `log_std_steps`. The bonus for
    entropy keeps the noise where it began; a policy that has learned what to do is then judged by what the noise adds,
    such as an impact, more than by what it does itself.

    Args:
        config: settings of the learner.
        steps: environment steps that were learned from so far.
    """
    if config.log_std_last is None:
        return 0.0
    return config.log_std + (config.log_std_last - config.log_std) * min(steps / config.log_std_steps, 1.0)
