"""Networks in NIR, the Neuromorphic Intermediate Representation, as nodes without a plugin.

:mod:`~neuros_learn.nir.network_file` reads the file, :mod:`~neuros_learn.nir.network` steps the
network, and ``plugin`` is the plugin of such a node. Source: Pedersen et al. 2024,
"Neuromorphic intermediate representation", Nature Communications 15, and https://neuroir.org.
"""
