"""What the levels of a model's diagrams stand for, for messages and pictures."""

from __future__ import annotations

from dataclasses import dataclass

from factored_polca.models import Model, Value


@dataclass(frozen=True)
class LevelNames:
    """The features and channels behind the levels, features in the diagrams' `order`."""

    model: Model
    order: tuple[str, ...]

    def describe(self, level: int) -> tuple[str, tuple[Value, ...]]:
        """The name of a level, primed for a next feature, and its values."""
        if level >= 2 * len(self.order):
            channel = self.model.observations[level - 2 * len(self.order)]
            return channel.name, channel.values
        feature = self.model.feature(self.order[level // 2])
        return feature.name + "'" * (level % 2), feature.values
