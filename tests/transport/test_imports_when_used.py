"""NumPy and PyYAML are imported when they are used, and are then what everybody else imports."""

from __future__ import annotations

import subprocess
import sys

import pytest

BEGIN = """
import sys
from neuros.transport.imports_when_used import imports_when_used
def is_there():
    return "numpy._core" in sys.modules
"""
IN_BLOCK = "with imports_when_used():\n    import numpy\n"


@pytest.mark.parametrize(
    "program",
    [
        IN_BLOCK + "assert not is_there() and 'numpy' not in sys.modules",
        IN_BLOCK + "assert numpy.float64(1).dtype == 'f8'\nassert numpy.zeros(2).sum() == 0",
        IN_BLOCK
        + "stand_in = numpy\nimport numpy\nassert is_there() and numpy is sys.modules['numpy']"
        + "\nassert stand_in is not numpy and stand_in.ndarray is numpy.ndarray",
        IN_BLOCK + "from numpy.linalg import norm\nassert numpy.linalg.norm is norm",
        IN_BLOCK + "numpy.add\nassert vars(numpy)['pi'] is sys.modules['numpy'].pi",
        "with imports_when_used():\n    import numpy\n    numpy.add\n    import numpy as again\n"
        "assert again is sys.modules['numpy']",
        "import numpy as first\n" + IN_BLOCK + "assert numpy is first is sys.modules['numpy']",
        IN_BLOCK + "try: numpy.nothing\nexcept AttributeError as e: assert 'nothing' in str(e)",
        "try:\n    with imports_when_used():\n        raise KeyError\nexcept KeyError: pass\n"
        "assert 'numpy' not in sys.modules",
        "from threading import Thread\n" + IN_BLOCK + "found = []\nuse = lambda: "
        "found.append(numpy.ndarray)\nthreads = [Thread(target=use) for _ in range(8)]\n"
        "for each in threads: each.start()\nfor each in threads: each.join()\n"
        "assert len(found) == 8 and len({*found}) == 1",
        "with imports_when_used():\n    import rclpy.parameter as parameter\n"
        "assert 'yaml' not in sys.modules and parameter.get_parameter_value('[1, 2]').type == 7\n"
        "import yaml\nassert yaml is not parameter.yaml and yaml.parser is parameter.yaml.parser",
    ],
)
def test_a_module_comes_when_it_is_used(program: str) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", BEGIN + program], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_where_there_is_none_the_error_comes_when_it_is_used() -> None:
    program = (
        BEGIN
        + IN_BLOCK
        + """
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            raise ModuleNotFoundError("No module named 'numpy'")
sys.meta_path.insert(0, Missing())
try:
    numpy.ndarray
except ModuleNotFoundError as error:
    print(error)
"""
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("No module named 'numpy'\n", "")
