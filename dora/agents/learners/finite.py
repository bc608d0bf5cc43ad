"""Checks that losses and networks are finite, so that a run stops before it keeps what is not."""

from collections.abc import Mapping

from torch import Tensor, nn

from dora.errors import RunFailure


def check_loss(name: str, value: Tensor) -> None:
    """Refuse a loss, or the norm of a gradient, that is not finite; call it before the gradient step.

    Raises:
        RunFailure: naming it.
    """
    if not bool(value.isfinite().all()):
        raise RunFailure(f"Training diverged: the {name} is {float(value.detach().mean())}.")


def check_modules(modules: Mapping[str, nn.Module]) -> None:
    """Refuse networks with parameters or buffers that are not finite.

    Raises:
        RunFailure: naming the first.
    """
    check_tensors({f"{key}/{name}": v for key, module in modules.items() for name, v in module.state_dict().items()})


def check_tensors(tensors: Mapping[str, Tensor]) -> None:
    """As `check_modules`, for tensors by name."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise RunFailure(f"Training diverged: {name} contains NaN or infinity.")
