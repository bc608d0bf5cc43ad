"""How strongly actions are pulled towards no correction, over the course of a run."""

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
