"""From files to a project: read, override, judge, build. All problems at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neuros.errors import Problem, ProjectError
from neuros.project.budgets import budgets_of
from neuros.project.build import Builder, connection
from neuros.project.checks import mistakes, remarks
from neuros.project.draft import Draft, read_draft
from neuros.project.message_types import NO_PACKAGES, MessagePackages
from neuros.project.model import Project
from neuros.project.overrides import apply_override
from neuros.project.paths import Roots
from neuros.project.plugin_checks import plugin_problems, unread_variables
from neuros.project.renaming import apply_namespace, apply_remaps
from neuros.project.ros_graph_checks import names_of
from neuros.project.scanner import SourceError, display_name
from neuros.project.suggest import did_you_mean

PROJECT_FILE = "project.json"


@dataclass(frozen=True)
class Loaded:
    """A valid project, and what may be a mistake in it all the same."""

    project: Project
    warnings: tuple[Problem, ...] = ()


def load_project(
    path: Path,
    *,
    workspace: Path,
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    packages: MessagePackages = NO_PACKAGES,
    namespace: str | None = None,
    remap: Sequence[str] = (),
    reads_plugins: bool = False,
) -> Loaded:
    """Load and check a project.

    Args:
        path: the project file, or a folder that holds ``project.json``.
        workspace: the folder that ``@path`` starts from, after the project's own.
        overrides: the texts of ``--set``, applied in this order.
        folder: the project's folder, if it is not the one of the file: the expanded project of
            a run lies in the folder of the run.
        packages: message packages of workspaces.
        namespace: the text of ``--namespace``, in the place of the project's own.
        remap: the texts of ``--remap``; they go before the project's own rules.
        reads_plugins: whether to look into plugins, too, which are not run.

    Raises:
        ProjectError: with every problem there is.
    """
    file = _project_file(path)
    roots = Roots((folder or file.parent).resolve(), workspace.resolve(), packages)
    try:
        draft = read_draft(file, roots)
    except SourceError as error:
        raise ProjectError([error.problem]) from None
    for text in overrides:
        draft.problems += apply_override(draft, text)
    if namespace is not None:
        apply_namespace(draft, namespace)
    draft.problems += apply_remaps(draft, remap)
    builder = Builder(draft)
    names = names_of(draft)
    nodes = tuple(builder.node(element) for element in draft.nodes)
    problems = [*draft.problems, *_judgements(draft), *builder.problems]
    connections = (
        ()
        if problems
        else tuple(
            connection(c, index, names.namespace) for index, c in enumerate(draft.connections)
        )
    )
    doubts: list[Problem] = []
    if reads_plugins:
        mistakes, doubts = plugin_problems(draft, nodes, None if problems else connections)
        problems += mistakes
    if problems:
        raise ProjectError(problems)
    if reads_plugins:
        doubts += unread_variables(draft, nodes, overrides)
    project = Project(
        name=_name(roots.project, file),
        nodes=nodes,
        connections=connections,
        file=roots.project / file.name,
        description=draft.root.string("description") or "",
        budgets=budgets_of(draft),
        names=names,
    )
    return Loaded(project, (*remarks(draft), *doubts))


def _judgements(draft: Draft) -> list[Problem]:
    # Imported here, so that whoever imports this module does not pay for jsonschema.
    from neuros.project.validate import violations

    return [*violations(draft), *mistakes(draft)]


def _project_file(path: Path) -> Path:
    """The project file, by its absolute path (the file itself may be a symbolic link)."""
    if path.is_dir():
        file = path.resolve() / PROJECT_FILE
        if not file.is_file():
            text = f"the folder '{path}' has no {PROJECT_FILE}"
            others = sorted(other.name for other in path.glob("*.json"))
            hint = f"it has {', '.join(others)}" if others else ""
            raise ProjectError([Problem(display_name(file), 0, 0, "", text, hint)])
        return file
    file = path.parent.resolve() / path.name
    if not file.exists():
        names = (entry.name for entry in file.parent.glob("*"))
        hint = did_you_mean(file.name, names)
        problem = Problem(display_name(file), 0, 0, "", "there is no such file", hint)
        raise ProjectError([problem])
    if file.suffix == ".py":
        text, hint = "is a plugin, not a project", f"name its {PROJECT_FILE}, or their folder"
        raise ProjectError([Problem(display_name(file), 1, 1, "/", text, hint)])
    return file


def _name(folder: Path, file: Path) -> str:
    """What a run of the project is called: the folder, and the file where it is a variant."""
    name = folder.name or "project"
    return name if file.name == PROJECT_FILE else f"{name}-{file.stem}"
