"""``neuros.viewers``, of which distributions with viewers import ``neuros.viewers.viewer``."""

__path__: list[str] = []
