"""What ROS adds to pyproject.toml, so that colcon builds NeuROS: docs/ros_workspace.md."""

from __future__ import annotations

import setuptools


class Distribution(setuptools.Distribution):
    """A distribution that colcon can read: it evaluates the ``repr`` of each field."""

    def parse_config_files(self, *args: object, **kwargs: object) -> None:
        """Read pyproject.toml, whose Python versions become an object without a literal."""
        super().parse_config_files(*args, **kwargs)
        self.python_requires = self.metadata.python_requires = str(self.python_requires)


# setuptools before 77, as ROS distributions have it, rejects an expression in pyproject.toml.
IS_OLD = int(setuptools.__version__.split(".")[0]) < 77

setuptools.setup(
    distclass=Distribution,
    **{"license" if IS_OLD else "license_expression": "MIT"},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/neuros"]),
        ("share/neuros", ["package.xml"]),
        ("lib/neuros", ["neuros/cli/script/neuros"]),
    ],
)
