"""Program that generates C and Python from message definitions, with rosidl's generators.

The generators print to standard output, replace it, and keep state in modules. So they run in an
isolated Python process, which reads an :class:`Order` from standard input. Each generator has its
own folder, since their files collide.
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
"""Type supports that the middleware needs; it makes its type object from the second one."""


@dataclass(frozen=True)
class Order:
    """A package to generate code for.

    Attributes:
        package: the name.
        folder: of the package.
        files: interface files, relative to the folder.
        output: for a folder of each generator.
        prefix: of ROS, which has the templates.
        shares: by name, share folders of packages that the files may refer to.
    """

    package: str
    folder: str
    files: Sequence[str]
    output: str
    prefix: str
    shares: dict[str, str]

    def text(self) -> str:
        """JSON for standard input."""
        return json.dumps(asdict(self))


def generated(output: Path, generator: str, package: str) -> Path:
    """The folder of the files that a generator makes for a package."""
    return output / generator / package


def describe(order: Order) -> Arguments:
    """Translate definitions to IDL, and write descriptions and hashes of types (REP 2011)."""
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
    """Files with the arguments of generators, and other files and folders that these expect.

    Attributes:
        idl: the IDL files, relative to their folder.
    """

    def __init__(self, order: Order, idl: Sequence[Path]) -> None:
        self._order, self.idl = order, tuple(idl)

    def file(self, generator: str, **more: Any) -> str:
        """Write the arguments of a generator, ``more`` of its own among them; returns the path."""
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
