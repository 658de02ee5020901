"""Class and package diagrams, drawn from the source: nothing is imported for them."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

_MANY = 25
"""With more classes a diagram shows names alone, and only of those that are related."""
_MANY_MODULES = 18
_SIMPLE = {"object", "Protocol", "Generic", "NamedTuple", "Enum"}


@dataclass
class Class:
    """One class, as its source tells."""

    name: str
    bases: list[str]
    attributes: list[str] = field(default_factory=list)
    methods: list[str] = field(default_factory=list)
    uses: set[str] = field(default_factory=set)


def class_diagram(files: Iterable[Path]) -> str:
    """Mermaid's text for all public classes of some files; empty where there are none."""
    classes = {each.name: each for file in files for each in _classes(file)}
    arrows = sorted(_arrows(classes))
    if len(classes) > _MANY:
        related = {name for arrow in arrows for name in (arrow[0], arrow[2])}
        classes = {name: classes[name] for name in classes if name in related}
        boxes = [f"  class {name}" for name in classes]
    else:
        boxes = [_box(each) for each in classes.values()]
    return (
        "\n".join(["classDiagram", *boxes, *(f"  {' '.join(a)}" for a in arrows)]) if boxes else ""
    )


def _classes(file: Path) -> Iterator[Class]:
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield _read(node)


def _read(node: ast.ClassDef) -> Class:
    result = Class(node.name, [ast.unparse(b).split("[")[0].split(".")[-1] for b in node.bases])
    for part in node.body:
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            result.attributes.append(part.target.id)
            result.uses |= _names(part.annotation)
        elif isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef):
            marks = [ast.unparse(each) for each in part.decorator_list]
            if any(mark.endswith(".setter") for mark in marks):
                continue
            is_property = any("property" in mark for mark in marks)
            (result.attributes if is_property else result.methods).append(part.name)
            if part.name == "__init__":
                for argument in (*part.args.args, *part.args.kwonlyargs):
                    result.uses |= _names(argument.annotation)
    result.attributes = [name for name in result.attributes if not name.startswith("_")]
    result.methods = [name for name in result.methods if not name.startswith("_")]
    return result


def _names(annotation: ast.AST | None) -> set[str]:
    return {n.id for n in ast.walk(annotation) if isinstance(n, ast.Name)} if annotation else set()


def _arrows(classes: Mapping[str, Class]) -> Iterator[tuple[str, str, str]]:
    for each in classes.values():
        for base in each.bases:
            if base in classes and base not in _SIMPLE:
                yield base, "<|--", each.name
        for used in each.uses - {each.name, *each.bases}:
            if used in classes:
                yield each.name, "-->", used


def _box(each: Class) -> str:
    rows = [f"    {name}" for name in each.attributes] + [f"    {name}()" for name in each.methods]
    return "\n".join([f"  class {each.name} {{", *rows, "  }"]) if rows else f"  class {each.name}"


def import_diagram(imports: Mapping[str, set[str]]) -> str:
    """Mermaid's text for who imports whom; what follows from other arrows is left out."""
    names = sorted({*imports, *(name for used in imports.values() for name in used)})
    # Rows of more than these are wider than a page; columns are as high as they need be.
    direction = "LR" if len(names) > _MANY_MODULES else "TD"
    number = {name: f"n{index}" for index, name in enumerate(names)}
    rows = [f'  {number[name]}["{name}"]' for name in names]
    for name in sorted(imports):
        for used in sorted(imports[name]):
            if not _leads_around(imports, name, used):
                rows.append(f"  {number[name]} --> {number[used]}")
    return "\n".join([f"flowchart {direction}", *rows])


def _leads_around(imports: Mapping[str, set[str]], start: str, end: str) -> bool:
    """Whether another way than the arrow itself leads from ``start`` to ``end``."""
    seen, new = {start}, imports.get(start, set()) - {end}
    while new:
        if end in new:
            return True
        seen |= new
        new = set().union(*(imports.get(name, set()) for name in new)) - seen
    return False


def imports_between(root: Path, depth: int, within: str = "neuros") -> dict[str, set[str]]:
    """Who imports whom among the parts of a package: names of ``depth`` words, below ``within``."""
    found: dict[str, set[str]] = {}
    for file in sorted((root / within.replace(".", "/")).rglob("*.py")):
        module = ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        importer = _part(module, depth, within)
        for imported in _imports(file, root):
            used = _part(imported, depth, within)
            if importer and used and importer != used:
                found.setdefault(importer, set()).add(used)
    return found


def _part(module: str, depth: int, within: str) -> str:
    words = module.split(".")
    is_within = module.startswith(within + ".") and len(words) >= depth
    return ".".join(words[len(within.split(".")) : depth]) if is_within else ""


@cache
def _imports(file: Path, root: Path) -> tuple[str, ...]:
    return tuple(_imported(file, root))


def _imported(file: Path, root: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            folder = root / node.module.replace(".", "/")
            for name in (alias.name for alias in node.names):
                is_module = (folder / f"{name}.py").exists() or (folder / name).is_dir()
                yield f"{node.module}.{name}" if is_module else node.module
