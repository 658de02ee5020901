"""The reference of the code: a page per package, with every module that lies in it."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from site_parts import uml
from site_parts.words import as_text, cell

PLUGINS = {"neuros_learn.nir.plugin"}  # can be imported in the environment of a node only
_ROLE = re.compile(r":\w+:`~?")


def packages(root: Path) -> dict[str, list[str]]:
    """The modules of each package, the package itself first."""
    found: dict[str, list[str]] = defaultdict(list)
    for top in ("neuros", *(each.parent.name for each in root.glob("extensions/*/*/__init__.py"))):
        base = source_of(root, top)
        for file in (base / top).rglob("*.py"):
            if (file.parent / "__init__.py").exists():
                path = file.relative_to(base).with_suffix("")
                package = ".".join(path.parent.parts)
                found[package].append(package if path.name == "__init__" else ".".join(path.parts))
    return {package: sorted({*found[package]} - PLUGINS) for package in sorted(found)}


def source_of(root: Path, package: str) -> Path:
    """The folder that a package is imported from: the checkout, or that of an extension."""
    extension = root / "extensions" / package.partition(".")[0].replace("_", "-")
    return extension if extension.is_dir() else root


def pages(root: Path) -> Iterator[tuple[str, str]]:
    """``(name, Markdown)`` of all pages."""
    found = packages(root)
    listed = "\n".join(f"code/{package}" for package in found)
    rows = "\n".join(
        f"| [{package}](code/{package}.md) | {_first_line(root, package)} |" for package in found
    )
    yield (
        "code",
        "# Modules, classes and functions\n\n"
        "Made from the docstrings. Plugins need `neuros.hooks` and, for their tests, "
        "`neuros.testing`; [Architecture](../architecture.md) says what the rest is for.\n\n"
        f"| package | what it is |\n| --- | --- |\n{rows}\n\n"
        f"```{{toctree}}\n:hidden:\n\n{listed}\n```\n",
    )
    for package, modules in found.items():
        yield f"code/{package}", _page(root, package, modules)
    yield "diagrams", _diagrams(root)


def leave_out_aliases(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Fields of named tuples have a docstring by themselves, which says nothing."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()


def _first_line(root: Path, package: str) -> str:
    file = source_of(root, package) / package.replace(".", "/") / "__init__.py"
    text = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
    plain = _ROLE.sub("`", text.partition("\n")[0])
    return cell(as_text(plain).removesuffix("."))


def _page(root: Path, package: str, modules: list[str]) -> str:
    parts = [f"# {package}\n"]
    for module in modules:
        title = "" if module == package else f"\n## {module.removeprefix(package + '.')}\n"
        parts.append(f"{title}\n```{{eval-rst}}\n.. automodule:: {module}\n```\n")
        if module == package:
            parts.append(_class_diagram(root, package))
    return "".join(parts)


def _class_diagram(root: Path, package: str) -> str:
    folder = source_of(root, package) / package.replace(".", "/")
    text = uml.class_diagram(sorted(folder.glob("*.py")))
    return f"\n## Class diagram\n\n```mermaid\n{text}\n```\n" if text else ""


def _diagrams(root: Path) -> str:
    """The page with all package diagrams; class diagrams are on the pages of the packages."""
    parts = [
        "# Package diagrams\n\nMade from the imports in the code, late ones too. An arrow leads "
        "from who imports to what is imported; one that follows from other arrows is left out. "
        "Class diagrams are on the [pages of the packages](code.md).\n",
        _imports(root, "neuros", 2),
    ]
    for package, modules in packages(root).items():
        if len(modules) > 2 and package != "neuros":
            parts.append(_imports(root, package, package.count(".") + 2))
    return "\n".join(parts)


def _imports(root: Path, package: str, depth: int) -> str:
    text = uml.import_diagram(uml.imports_between(source_of(root, package), depth, package))
    return f"\n## {package}\n\n```mermaid\n{text}\n```\n"
