"""Learning: environments, datasets, and trained networks as nodes.

:mod:`~neuros_learn.gym` makes a project an environment of Gymnasium,
:mod:`~neuros_learn.datasets` makes recorded runs datasets, and :mod:`~neuros_learn.nir` runs
trained networks as nodes. Users import them as ``neuros.gym``, ``neuros.datasets`` and
``neuros.snn.nir``.
"""
