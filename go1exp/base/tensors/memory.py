"""State that a term carries from one policy step to the next."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


class Memory:
    """Base of everything stateful in an env: names its tensors once, so that saving and resuming cannot miss one.

    A subclass assigns tensors to the attributes it lists in ``memory`` and changes them in place only: a captured GPU
    graph would not see an assignment.
    """

    memory: tuple[str, ...] = ()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors named in ``memory``."""
        return {name: getattr(self, name).clone() for name in self.memory}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Write the tensors back, in place; raise KeyError if one is missing."""
        for name in self.memory:
            getattr(self, name).copy_(state[name])
