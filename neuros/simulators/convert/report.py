"""Report of a conversion: problems, and elements that MuJoCo does not support."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from neuros.errors import DescriptionError, Problem
from neuros.simulators.convert.elements import Element

_GAZEBO_CODE = "code that runs inside Gazebo; a NeuROS plugin takes its place"
_PICTURE = "has to do with how Gazebo draws; MuJoCo draws in its own way"
_ENGINE = "a setting of another physics engine"
_NODE_FILE = "the node file says when and where packets go (`rate`, connections)"
_STIFFNESS = "how stiff limits and contacts are is another number in MuJoCo (solref)"
_ENVIRONMENT = "MuJoCo simulates no such environment"

_UNSUPPORTED_ELEMENTS: Mapping[str, str] = {
    "plugin": _GAZEBO_CODE,
    "actor": "MuJoCo has no animated actors",
    "population": "MuJoCo has no populations: include the models one by one",
    "road": "MuJoCo has no roads",
    "gui": _PICTURE,
    "scene": _PICTURE,
    "audio": "MuJoCo has no sound",
    "audio_sink": "MuJoCo has no sound",
    "audio_source": "MuJoCo has no sound",
    "wind": _ENVIRONMENT,
    "atmosphere": _ENVIRONMENT,
    "spherical_coordinates": "MuJoCo has no place on Earth",
    "state": "a saved state; the model starts in its initial one",
    "enable_wind": _ENVIRONMENT,
    "fluid_added_mass": _ENVIRONMENT,
    "ode": _ENGINE,
    "bullet": _ENGINE,
    "simbody": _ENGINE,
    "dart": _ENGINE,
    "physics": _ENGINE,
    "real_time_factor": "how fast it runs is up to the plugin (`run_asynchronous`)",
    "real_time_update_rate": "how fast it runs is up to the plugin (`run_asynchronous`)",
    "max_contacts": "MuJoCo limits no number of contacts per geom",
    "allow_auto_disable": "MuJoCo puts bodies to sleep by an option of the whole world",
    "velocity_decay": "MuJoCo has damping in joints, not in links",
    "must_be_base_link": "every link is a body of its own",
    "kinematic": "MuJoCo moves every body by forces, or by the plugin (mocap)",
    "velocity": "MuJoCo does not limit the velocity of a joint",
    "stiffness": _STIFFNESS,
    "dissipation": _STIFFNESS,
    "bounce": "MuJoCo's contacts bounce by their damping (solref), not by a coefficient",
    "soft_contact": "MuJoCo has no soft bodies of that kind",
    "torsional": "MuJoCo's torsional friction is a length, not a coefficient",
    "friction": "a friction model of another engine",
    "fdir1": "MuJoCo's friction has no direction of its own",
    "slip1": "MuJoCo has no force-dependent slip",
    "slip2": "MuJoCo has no force-dependent slip",
    "laser_retro": "MuJoCo's rangefinders measure distances only",
    "cast_shadows": _PICTURE,
    "visibility_flags": _PICTURE,
    "meta": _PICTURE,
    "lighting": _PICTURE,
    "ambient": _PICTURE,
    "specular": _PICTURE,
    "emissive": _PICTURE,
    "shader": _PICTURE,
    "pbr": "textures and surfaces of Gazebo's renderer",
    "render_order": _PICTURE,
    "double_sided": _PICTURE,
    "shininess": _PICTURE,
    "projector": "MuJoCo has no projectors",
    "battery": "MuJoCo has no batteries",
    "light_map": _PICTURE,
    "particle_emitter": "MuJoCo has no particles",
    "gripper": "a gripper grips by its contacts",
    "clip": "MuJoCo has one near and one far plane for all cameras (`visual/map`)",
    "distortion": "MuJoCo's cameras are pinhole cameras",
    "lens": "MuJoCo's cameras are pinhole cameras",
    "save": "record with `launch -r`",
    "update_rate": _NODE_FILE,
    "topic": _NODE_FILE,
    "always_on": _NODE_FILE,
    "visualize": _PICTURE,
    "enable_metrics": _NODE_FILE,
    "noise": "MuJoCo adds no noise",
    "format": "images are rgb8",
    "anti_aliasing": "see `fine_rendering` of neuros.simulators.mujoco.MuJoCo",
    "optical_frame_id": _NODE_FILE,
    "orientation_reference_frame": "the orientation is that in the world",
    "enable_orientation": "the orientation is always sent",
    "depth_camera": "MuJoCo's cameras show colours",
    "submesh": "MuJoCo takes a mesh as a whole",
    "joint_physics": _ENGINE,
    "frame_id": _NODE_FILE,
}
"""Why elements of SDF have no counterpart in MuJoCo, by their tags."""

_UNKNOWN_ELEMENT = "the converter does not know this element"


@dataclass(frozen=True)
class NotTaken:
    """Something in a description that the result does not have, or has otherwise.

    Attributes:
        place: ``file:line`` of the first one.
        path: its path in the document.
        why: the reason, in words.
        count: how many of its kind there are, for this reason.
    """

    place: str
    path: str
    why: str
    count: int = 1

    def __str__(self) -> str:
        more = f" (and {self.count - 1} more)" if self.count > 1 else ""
        return f"{self.place}: {self.path}: {self.why}{more}"


class Report:
    """Gathers problems and notes while a description is read."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []
        self._notes: list[tuple[Element, str]] = []

    def problem(self, element: Element, text: str, hint: str = "") -> None:
        """Something that makes a conversion impossible."""
        self.problems.append(element.problem(text, hint))

    def note(self, element: Element, why: str) -> None:
        """Something that is not taken over, or not as it is; it counts as read."""
        element.take_all()
        self._notes.append((element, why))

    def remark(self, element: Element, why: str) -> None:
        """Note an element whose children are still to be read."""
        element.taken = True
        self._notes.append((element, why))

    def note_unread(self, roots: Iterable[Element]) -> None:
        """Note the topmost elements that were not read."""
        for root in roots:
            for child in root.children:
                if not child.taken:
                    is_extension = ":" in child.tag
                    why = _UNSUPPORTED_ELEMENTS.get(child.tag, _UNKNOWN_ELEMENT)
                    self.note(child, "an extension of its author's own" if is_extension else why)
            self.note_unread(root.children)

    def raise_any(self) -> None:
        """Raise ``DescriptionError`` with all problems, if there are any."""
        if self.problems:
            raise DescriptionError(self.problems)

    def not_taken(self) -> Sequence[NotTaken]:
        """The notes in the order of their places, equal ones of one kind as one."""
        notes = sorted(self._notes, key=lambda note: (str(note[0].file), note[0].line))
        groups: dict[tuple[str, str, str], list[Element]] = {}
        for element, why in notes:
            groups.setdefault((str(element.file), element.kind, why), []).append(element)
        return [
            NotTaken(elements[0].place, elements[0].path, why, len(elements))
            for (_, _, why), elements in groups.items()
        ]
