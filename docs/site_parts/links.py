"""Links that lead out of the pages: into the code, and to folders.

GitHub shows the file or the folder. The site shows what it has: the reference of a module, class or
function, and the README of a folder. All other files are copied, so that the link works offline.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.domains.python import PythonDomain
from sphinx.environment import BuildEnvironment

_PUBLIC = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*")


class Python(PythonDomain):
    """Python's names; one whose last part no object here has is not searched for.

    Sphinx goes through all objects for each such name, of which other projects have most: a fifth
    of the time of a build.
    """

    _last_parts: frozenset[str] = frozenset()
    _count = 0

    def find_obj(self, env: BuildEnvironment, *names: Any, **more: Any) -> list[Any]:
        """As Sphinx does; ``names`` are of the module, the class and the object."""
        if len(self.objects) != self._count:
            self._count = len(self.objects)
            self._last_parts = frozenset(name.rpartition(".")[2] for name in self.objects)
        last_part = names[2].removesuffix("()").rpartition(".")[2]
        return super().find_obj(env, *names, **more) if last_part in self._last_parts else []


def lead_to_pages(app: Sphinx, document: nodes.document) -> None:
    """Turn the links of one page."""
    for link in list(document.findall(addnodes.download_reference)):
        if module := _module(app, _path(app.env, link["reftarget"])):
            link.replace_self(_to_code(app.env, module, link))
    for link in list(document.findall(addnodes.pending_xref)):
        folder = _path(app.env, link["reftarget"])
        if link.get("reftype") == "myst" and (Path(app.srcdir) / folder).is_dir():
            _lead_to_readme(app.env, link, folder)


def _path(env: BuildEnvironment, target: str) -> str:
    """What a link leads to, from the root of the checkout."""
    base = "" if target.startswith("/") else posixpath.dirname(env.current_document.docname)
    return posixpath.normpath(posixpath.join(base, target.lstrip("/").partition("#")[0]))


def _module(app: Sphinx, path: str) -> str | None:
    """The name of a module of ``neuros``, if that file is one."""
    file = Path(app.srcdir) / path
    is_module = path.startswith("neuros/") and path.endswith(".py")
    if not is_module or not (file.parent / "__init__.py").exists():
        return None
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _to_code(env: BuildEnvironment, module: str, link: nodes.Element) -> addnodes.pending_xref:
    """A reference to what the link's text names in a module, or to the module."""
    text = link.astext()
    names_a_member = _PUBLIC.fullmatch(text) and not text.endswith(".py")
    member = text if text.startswith("neuros.") else f"{module}.{text}"
    target = member if names_a_member else module
    reference = addnodes.pending_xref(
        "",
        *link.children,
        refdomain="py",
        reftype="obj" if names_a_member else "mod",
        reftarget=target,
        refexplicit=True,
        refdoc=env.current_document.docname,
        refwarn=True,
    )
    reference["py:module"] = reference["py:class"] = None
    return reference


def _lead_to_readme(env: BuildEnvironment, link: nodes.Element, folder: str) -> None:
    """Lead to the README in the folder, or in the one around it."""
    for place in (folder, posixpath.dirname(folder)):
        if f"{place}/README" in env.found_docs:
            link.update_basic_atts({})
            link["refdomain"], link["reftype"] = "std", "doc"
            link["reftarget"], link["refexplicit"] = f"/{place}/README", True
            return
