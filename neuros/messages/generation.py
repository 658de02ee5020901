"""Generates C and Python from definitions with rosidl's generators, called as CMake calls them.

They print to standard output, replace it, and keep state in modules: they run in a process of
their own, an isolated Python, which reads what to do from standard input.
Each has a folder of its own, since their files collide.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

INTERFACES = "rosidl_adapter"
DESCRIPTIONS = "rosidl_generator_type_description"
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""What the middleware needs; the second one, too: it makes its type object of it."""


@dataclass(frozen=True)
class Order:
    """A package to generate code for.

    Attributes:
        package: the name.
        folder: the package's.
        files: its interface files, relative to it.
        output: gets a folder per generator.
        prefix: of ROS, where the templates are.
        shares: the share folders of packages that it may refer to, by name.
    """

    package: str
    folder: str
    files: Sequence[str]
    output: str
    prefix: str
    shares: dict[str, str]

    def text(self) -> str:
        """For standard input."""
        return json.dumps(asdict(self))


def generated(output: Path, generator: str, package: str) -> Path:
    """The folder of the files that a generator makes of a package."""
    return output / generator / package


def describe(order: Order) -> Arguments:
    """Translate the definitions, and describe each type with its hash (REP 2011)."""
    from rosidl_adapter import convert_to_idl
    from rosidl_generator_type_description import generate_type_hash

    folder, idl = Path(order.folder), generated(Path(order.output), INTERFACES, order.package)
    files = [
        convert_to_idl(folder, order.package, Path(file), idl).relative_to(idl)
        for file in order.files
    ]
    arguments = Arguments(order, files)
    shares = [f"{name}:{share}" for name, share in order.shares.items()]
    generate_type_hash(arguments.file(DESCRIPTIONS, include_paths=shares))
    return arguments


def generate(order: Order) -> None:
    """Run all generators."""
    from rosidl_generator_c import generate_c
    from rosidl_generator_py import generate_py
    from rosidl_typesupport_c import generate_c as generate_dispatch
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    arguments = describe(order)
    descriptions = generated(Path(order.output), DESCRIPTIONS, order.package)
    generate_c(
        arguments.file(
            "rosidl_generator_c",
            type_description_tuples=[
                f"{file}:{(descriptions / file).with_suffix('.json')}" for file in arguments.idl
            ],
            ros_interface_files=[str(Path(order.folder, file)) for file in order.files],
        )
    )
    generate_introspection(arguments.file("rosidl_typesupport_introspection_c"))
    generate_typesupport_fastrtps_c(arguments.file("rosidl_typesupport_fastrtps_c"))
    generate_dispatch(arguments.file("rosidl_typesupport_c"), list(TYPE_SUPPORTS))
    generate_py(arguments.file("rosidl_generator_py"), ["rosidl_typesupport_c"])


class Arguments:
    """The files in which generators expect their arguments, and what they expect to be there.

    Attributes:
        idl: the translated definitions, relative to their folder.
    """

    def __init__(self, order: Order, idl: Sequence[Path]) -> None:
        self._order, self.idl = order, tuple(idl)

    def file(self, generator: str, **more: Any) -> str:
        """The path of the file for a generator; ``more`` is what only this one takes."""
        from rosidl_cli.command.helpers import generate_visibility_control_file

        order = self._order
        output = generated(Path(order.output), generator, order.package)
        idl = generated(Path(order.output), INTERFACES, order.package)
        for interface in order.files:
            (output / Path(interface).parent / "detail").mkdir(parents=True, exist_ok=True)
        templates = Path(order.prefix, "share", generator, "resource")
        for template in templates.glob("*__visibility_control.h.in"):
            # All headers of a package include the one in ``msg``.
            generate_visibility_control_file(
                package_name=order.package,
                template_path=template,
                output_path=output / "msg" / template.stem,
            )
        content = {
            "package_name": order.package,
            "output_dir": str(output),
            "template_dir": str(templates),
            "idl_tuples": [f"{idl}:{file}" for file in self.idl],
            "target_dependencies": [],
            **more,
        }
        file = Path(order.output, f"{generator}.json")
        file.write_text(json.dumps(content), "utf-8")
        return str(file)


if __name__ == "__main__":
    generate(Order(**json.load(sys.stdin)))
