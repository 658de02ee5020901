"""Program that generates C and Python from message definitions, with rosidl's generators.

The generators print to standard output, replace it, and keep state in modules. So they run in an
isolated Python process, which reads an :class:`Order` as JSON from standard input. Each generator
has its own folder, since their files collide.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

INTERFACES = "rosidl_adapter"
DESCRIPTIONS = "rosidl_generator_type_description"
TYPE_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""Type supports that the middleware needs; it makes its type object from the second one."""


class Order(NamedTuple):
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

    def arguments(self, generator: str, **more: Any) -> AbstractContextManager[str]:
        """A file with the arguments of a generator, ``more`` of its own among them.

        Makes the folders and headers that the generator expects.
        """
        from rosidl_cli.command import helpers

        output = generated(Path(self.output), generator, self.package)
        for file in self.files:
            (output / Path(file).parent / "detail").mkdir(parents=True, exist_ok=True)
        templates = Path(self.prefix, "share", generator, "resource")
        for template in templates.glob("*__visibility_control.h.in"):
            # All headers of a package include the one in ``msg``.
            helpers.generate_visibility_control_file(
                package_name=self.package,
                template_path=template,
                output_path=output / "msg" / template.stem,
            )
        idl = generated(Path(self.output), INTERFACES, self.package)
        common = helpers.legacy_generator_arguments(
            package_name=self.package,
            interface_files=[f"{idl}:{Path(file).with_suffix('.idl')}" for file in self.files],
            include_paths=[],
            templates_path=templates,
            output_path=output,
        )
        arguments: AbstractContextManager[str] = helpers.generator_arguments_file(**common, **more)
        return arguments


def generated(output: Path, generator: str, package: str) -> Path:
    """The folder of the files that a generator makes for a package."""
    return output / generator / package


def describe(order: Order) -> None:
    """Translate definitions to IDL, and write descriptions and hashes of types (REP 2011)."""
    from rosidl_adapter import convert_to_idl
    from rosidl_generator_type_description import generate_type_hash

    idl = generated(Path(order.output), INTERFACES, order.package)
    for file in order.files:
        convert_to_idl(Path(order.folder), order.package, Path(file), idl)
    shares = [f"{name}:{share}" for name, share in order.shares.items()]
    with order.arguments(DESCRIPTIONS, include_paths=shares) as file:
        generate_type_hash(file)


def generate(order: Order) -> None:
    from rosidl_generator_c import generate_c
    from rosidl_generator_py import generate_py
    from rosidl_typesupport_c import generate_c as generate_dispatch
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    describe(order)
    descriptions = generated(Path(order.output), DESCRIPTIONS, order.package)
    idl = [Path(file).with_suffix(".idl") for file in order.files]
    with order.arguments(
        "rosidl_generator_c",
        type_description_tuples=[f"{f}:{(descriptions / f).with_suffix('.json')}" for f in idl],
        ros_interface_files=[str(Path(order.folder, file)) for file in order.files],
    ) as file:
        generate_c(file)
    for name, run, *more in (
        ("rosidl_typesupport_introspection_c", generate_introspection),
        ("rosidl_typesupport_fastrtps_c", generate_typesupport_fastrtps_c),
        ("rosidl_typesupport_c", generate_dispatch, list(TYPE_SUPPORTS)),
        ("rosidl_generator_py", generate_py, ["rosidl_typesupport_c"]),
    ):
        with order.arguments(name) as file:
            run(file, *more)


if __name__ == "__main__":
    generate(Order(*json.load(sys.stdin)))
