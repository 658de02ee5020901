"""What ROS adds to pyproject.toml, so that colcon builds NeuROS: docs/ros_workspace.md."""

from __future__ import annotations

import re
from pathlib import Path

import setuptools

REPOSITORY = "https://github.com/LeePerry/NeuROS"


class Distribution(setuptools.Distribution):
    """A distribution that colcon can read: it evaluates the ``repr`` of each field."""

    def parse_config_files(self, *args: object, **kwargs: object) -> None:
        """Read pyproject.toml, whose Python versions become an object without a literal."""
        super().parse_config_files(*args, **kwargs)
        self.python_requires = self.metadata.python_requires = str(self.python_requires)


# setuptools before 77, as ROS distributions have it, rejects an expression in pyproject.toml.
IS_OLD = int(setuptools.__version__.split(".")[0]) < 77


def readme() -> str:
    """README.md for a package index, where a link within the repository would lead nowhere."""
    text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    text = re.sub(r"!\[([^]]*)\]\((?!https?:)", rf"![\1]({REPOSITORY}/raw/main/", text)
    return re.sub(r"(?<!!)\[([^]]*)\]\((?!https?:|#)", rf"[\1]({REPOSITORY}/blob/main/", text)


setuptools.setup(
    long_description=readme(),
    long_description_content_type="text/markdown",
    distclass=Distribution,
    **{"license" if IS_OLD else "license_expression": "MIT"},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/neuros"]),
        ("share/neuros", ["package.xml"]),
        ("lib/neuros", ["neuros/cli/script/neuros"]),
    ],
)
