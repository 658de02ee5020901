"""Policies as nodes without a plugin, ``"policy": "walk.onnx"``.

:mod:`~neuros_learn.policies.model` opens a policy, :mod:`~neuros_learn.policies.mapping` connects
the ports of the node with its inputs and outputs, and ``plugin`` is the plugin of such a node.
:mod:`~neuros_learn.policies.export` writes what was trained in an environment of a project.
"""
