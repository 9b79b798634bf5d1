"""Registering a type with LeRobot when another plugin may have taken its name."""

import logging
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def register(registry: Any, name: str) -> Callable[[type[T]], type[T]]:
    """Register a configuration class with a draccus registry, as `registry.register_subclass(name)` does.

    If another plugin has registered the name, it keeps it, with a warning; draccus alone would raise, and everything
    else that this package registers would be lost.
    """

    def decorate(config_class: type[T]) -> type[T]:
        taken = registry.get_known_choices().get(name)
        if taken is None:
            return registry.register_subclass(name)(config_class)
        logging.getLogger(__name__).warning(
            "Type '%s' is registered by %s already; this package's %s is left out.",
            name,
            taken.__module__,
            config_class.__name__,
        )
        return config_class

    return decorate
