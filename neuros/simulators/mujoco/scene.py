"""A world for a browser: the geometry of the compiled model, once, and poses of moving bodies.

Nothing is rendered here. The geometry is JSON; its arrays are zlib-compressed, in base64.
"""

from __future__ import annotations

import base64
import json
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import mujoco
import numpy as np

FRAMES_PER_S = 30
_PERIOD_S = 1 / FRAMES_PER_S
_WATCHED_S = 2.0
_MOST_FRAMES = 60
_MOST_GROUP = 2  # MuJoCo's own viewer hides the groups 3 to 5 at first, too
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_GEOMS = mujoco.mjtGeom
_SHAPES = {
    getattr(_GEOMS, f"mjGEOM_{name.upper()}").value: name
    for name in ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
} | {_GEOMS.mjGEOM_HFIELD.value: "mesh", _GEOMS.mjGEOM_SDF.value: "mesh"}
_LIGHT_VECTORS = ("pos", "dir", "diffuse", "ambient")
_MATERIAL = ("emission", "specular", "shininess")
# A plugin may change these while the world runs.
_VISIBLE = ("geom_rgba", "geom_size", "geom_pos", "geom_quat", "mat_rgba", "site_rgba", "site_pos")


class WorldView:
    """A world as observers see it: its geometry, and its poses while observers ask for them.

    The stepping thread calls :meth:`record`, other threads call :meth:`observe`.

    Args:
        world: returns the present model and data, and the simulated time in seconds.
        clock: wall clock in seconds.

    Attributes:
        is_watched: whether the stepping thread must call :meth:`record` after each step.
        is_stepping: whether the data may change now; the stepping thread sets it.
    """

    def __init__(
        self,
        world: Callable[[], tuple[Any, Any, float]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._world, self._clock = world, clock
        self.is_watched = self.is_stepping = False
        self._watched_until_s = self._next_s = self._begin_s = clock()
        self._frames: deque[tuple[int, list[Any]]] = deque(maxlen=_MOST_FRAMES)
        self._count = 0
        self._given: dict[int, int] = {}
        self._model: Any = None
        self._models = 0
        self._moving = _Moving()
        self._wants_contacts = False

    def record(self) -> None:
        """Keep the present poses, at most 30 times per second."""
        now_s = self._clock()
        if now_s > self._watched_until_s:
            self.is_watched = False
        elif now_s >= self._next_s:
            self._next_s = max(self._next_s + _PERIOD_S, now_s)
            self._count += 1
            self._frames.append((self._count, self._frame(now_s)))

    def observe(self, wanted: Mapping[str, Any], asker: int) -> dict[str, Any]:
        """The version of the geometry, and the wanted parts.

        Args:
            wanted: ``frames``: poses since the asker's last call, and recording from now on;
                ``contacts``: contact points in these frames; ``geometry``: the whole geometry.
            asker: identifies the observer.
        """
        model, *_ = self._world()
        if model is not self._model:
            self._moving = _Moving(model)
            self._frames.clear()
            self._model, self._models = model, self._models + 1
        crc = 0
        for name in _VISIBLE:
            crc = zlib.crc32(getattr(model, name).tobytes(), crc)
        found: dict[str, Any] = {"version": f"{self._models}-{crc:x}"}
        if wanted.get("geometry"):
            found["geometry"] = json.dumps({**found, **geometry(model)})
        if not wanted.get("frames"):
            return found
        now_s = self._clock()
        self._watched_until_s = now_s + _WATCHED_S
        self._wants_contacts = bool(wanted.get("contacts"))
        # Set before is_stepping is read: a step that begins in between is recorded at its end.
        self.is_watched = True
        last = self._given.get(asker, self._count)
        frames = [frame for number, frame in tuple(self._frames) if number > last]
        if not frames and not self.is_stepping:  # the world may stand still for long
            frame = self._frame(now_s)
            if not self.is_stepping:
                frames.append(frame)
        self._given[asker] = self._count
        return found | {"frames": frames}

    def _frame(self, now_s: float) -> list[Any]:
        """Wall and simulated time in seconds, poses, and contacts if they are wanted."""
        _, data, sim_s = self._world()
        frame = [round(now_s - self._begin_s, 4), sim_s, _text(self._moving.poses(data))]
        if self._wants_contacts:
            contact = data.contact
            frame.append(_text(np.hstack([contact.pos, contact.frame[:, :3]])))
        return frame


class _Moving:
    """Moving parts of a model: bodies with joints, mocap bodies, their children, tracking cameras.

    Attributes:
        bodies, cameras: their ids.
    """

    def __init__(self, model: Any = None) -> None:
        self.bodies: list[int] = []
        self.cameras: list[int] = []
        if model is None:
            return
        moves = (model.body_jntnum > 0) | (model.body_mocapid >= 0)
        for body in range(1, model.nbody):  # parents come first
            moves[body] |= moves[model.body_parentid[body]]
        self.bodies = np.flatnonzero(moves).tolist()
        self.cameras = np.flatnonzero(model.cam_mode).tolist()

    def poses(self, data: Any) -> Any:
        """A row of x, y, z in metres and a quaternion (w, x, y, z) for each, in the world."""
        rows = np.empty((len(self.bodies) + len(self.cameras), 7))
        count = len(self.bodies)
        rows[:count, :3], rows[:count, 3:] = data.xpos[self.bodies], data.xquat[self.bodies]
        for row, camera in zip(rows[count:], self.cameras, strict=True):
            row[:3] = data.cam_xpos[camera]
            mujoco.mju_mat2Quat(row[3:], data.cam_xmat[camera])
        return rows


def geometry(model: Any) -> dict[str, Any]:
    """The drawn parts of a model, ready for JSON; lengths in metres, quaternions as w, x, y, z.

    ``bodies`` have the pose of the initial state. ``moving`` are the bodies with a row in each
    frame, in its order, before ``moving_cameras``; ``roots`` are what a camera may follow, the
    moving bodies on fixed parents, those with joints first, and ``reaches`` how far each extends
    with its children. Geoms, sites, lights and cameras are relative to their body.
    Geoms of groups that MuJoCo's viewer hides, skins, flexes and tendons are left out.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moving, visual, headlight = _Moving(model), model.vis, model.vis.headlight
    meshes = _Meshes(model)
    roots = sorted(
        (body for body in moving.bodies if model.body_parentid[body] not in moving.bodies),
        key=lambda body: model.body_mocapid[body] >= 0,
    )
    return {
        "bodies": [
            {"name": model.body(body).name, **_pose(data.xpos[body], data.xquat[body])}
            for body in range(model.nbody)
        ],
        "moving": moving.bodies,
        "roots": [_seen(model, body) for body in roots],
        "reaches": [_reach(model, data, _seen(model, body)) for body in roots],
        "moving_cameras": moving.cameras,
        "geoms": list(_geoms(model, meshes)),
        "sites": [
            _shape(model, site)
            for site in map(model.site, range(model.nsite))
            if site.group[0] <= _MOST_GROUP
        ],
        "meshes": meshes.found,
        "textures": [_texture(model, number) for number in range(model.ntex)],
        "lights": [
            {
                "type": int(light.type[0]),
                "body": int(light.bodyid[0]),
                **{name: getattr(light, name).tolist() for name in _LIGHT_VECTORS},
                "cutoff": float(light.cutoff[0]),
            }
            for light in map(model.light, range(model.nlight))
            if light.active[0]
        ],
        "cameras": [
            {
                "name": camera.name or f"camera {camera.id}",
                "body": int(camera.bodyid[0]),
                **_pose(camera.pos, camera.quat),
                "fovy": float(camera.fovy[0]),
            }
            for camera in map(model.camera, range(model.ncam))
        ],
        "view": {
            "center": model.stat.center.tolist(),
            "extent": float(model.stat.extent),
            "azimuth": float(visual.global_.azimuth),
            "elevation": float(visual.global_.elevation),
            "fovy": float(visual.global_.fovy),
            "near": float(visual.map.znear * model.stat.extent),
            "far": float(visual.map.zfar * model.stat.extent),
            "contact_radius": float(visual.scale.contactwidth * model.stat.meansize),
        },
        "headlight": {
            "ambient": headlight.ambient.tolist(),
            "diffuse": headlight.diffuse.tolist() if headlight.active else [0, 0, 0],
        },
    }


def _seen(model: Any, body: int) -> int:
    """The body, or below bodies that have nothing but a joint and a child, what they carry."""
    while not model.body_geomnum[body]:
        children = np.flatnonzero(model.body_parentid == body)
        if len(children) != 1:
            break
        body = int(children[0])
    return body


def _reach(model: Any, data: Any, root: int) -> float:
    """How far the geoms of a body and of its children are from its position, in metres."""
    is_part = np.arange(model.nbody) == root
    for body in range(root + 1, model.nbody):  # parents come first
        is_part[body] |= is_part[model.body_parentid[body]]
    geoms = is_part[model.geom_bodyid] & (model.geom_group <= _MOST_GROUP)
    away = np.linalg.norm(data.geom_xpos[geoms] - data.xpos[root], axis=1)
    return float(max(away + model.geom_rbound[geoms], default=0.0))


def _geoms(model: Any, meshes: _Meshes) -> Iterator[dict[str, Any]]:
    for geom in map(model.geom, range(model.ngeom)):
        kind, material = int(geom.type[0]), int(geom.matid[0])
        if kind not in _SHAPES or geom.group[0] > _MOST_GROUP:
            continue
        found = _shape(model, geom)
        if found["rgba"][3] == 0:
            continue
        if _SHAPES[kind] == "mesh":
            found["mesh"] = meshes.number(kind, int(geom.dataid[0]))
        if material >= 0:
            found |= _material(model.mat(material))
        yield found


def _shape(model: Any, element: Any) -> dict[str, Any]:
    """The common part of geoms and sites."""
    material, rgba = int(element.matid[0]), element.rgba
    if material >= 0 and np.allclose(rgba, _DEFAULT_RGBA):
        rgba = model.mat_rgba[material]
    return {
        "shape": _SHAPES[int(element.type[0])],
        "size": element.size.tolist(),
        "body": int(element.bodyid[0]),
        **_pose(element.pos, element.quat),
        "rgba": rgba.tolist(),
    }


def _material(material: Any) -> dict[str, Any]:
    found = {name: float(getattr(material, name)[0]) for name in _MATERIAL}
    textures = material.texid
    roles = (mujoco.mjtTextureRole.mjTEXROLE_RGB, mujoco.mjtTextureRole.mjTEXROLE_RGBA)
    texture = next((int(textures[role]) for role in roles if textures[role] >= 0), None)
    if texture is not None:
        found |= {
            "texture": texture,
            "repeat": material.texrepeat.tolist(),
            "is_uniform": bool(material.texuniform[0]),
        }
    return found


class _Meshes:
    """The meshes and height fields of geoms, each once."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._numbers: dict[tuple[bool, int], int] = {}
        self.found: list[dict[str, str]] = []

    def number(self, kind: int, data_id: int) -> int:
        """The place of a mesh among those found."""
        is_field = kind == mujoco.mjtGeom.mjGEOM_HFIELD.value
        if (is_field, data_id) not in self._numbers:
            self._numbers[is_field, data_id] = len(self.found)
            self.found.append((self._field if is_field else self._surface)(data_id))
        return self._numbers[is_field, data_id]

    def _surface(self, mesh: int) -> dict[str, str]:
        """Vertices with normals (and texture coordinates), and three vertex numbers per face.

        MuJoCo numbers vertices, normals and coordinates apart; a browser has one number for all.
        """
        model = self._model

        def part(name: str, kind: str, first: Any, count: Any) -> Any:
            begin = first[mesh]
            return getattr(model, f"mesh_{name}")[begin : begin + count[mesh]].astype(kind)

        faces = (model.mesh_faceadr, model.mesh_facenum)
        columns = [(part("face", "i8", *faces), "position", "vert")]
        columns.append((part("facenormal", "i8", *faces), "normal", "normal"))
        if model.mesh_texcoordnum[mesh]:
            columns.append((part("facetexcoord", "i8", *faces), "uv", "texcoord"))
        key = np.zeros(3 * model.mesh_facenum[mesh], "i8")
        for numbers, *_ in columns:
            key = key * (int(numbers.max(initial=0)) + 1) + numbers.ravel()
        _, firsts, index = np.unique(key, return_index=True, return_inverse=True)
        found = {"index": _packed(index.astype("<u4"))}
        for numbers, name, of in columns:
            values = part(
                of, "<f4", getattr(model, f"mesh_{of}adr"), getattr(model, f"mesh_{of}num")
            )
            found[name] = _packed(values[numbers.ravel()[firsts]])
        return found

    def _field(self, field: int) -> dict[str, str]:
        """The surface of a height field; the browser computes its normals."""
        model = self._model
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        begin = model.hfield_adr[field]
        heights = model.hfield_data[begin : begin + rows * columns]
        half_x, half_y, height, _ = model.hfield_size[field]
        x, y = np.meshgrid(
            np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows)
        )
        points = np.stack([x.ravel(), y.ravel(), heights * height], axis=1)
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        a, b, c, d = corner, corner + 1, corner + columns, corner + columns + 1
        faces = np.stack([a, b, d, a, d, c], axis=1)
        return {"position": _packed(points.astype("<f4")), "index": _packed(faces.astype("<u4"))}


def _texture(model: Any, texture: int) -> dict[str, Any]:
    width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
    channels, begin = int(model.tex_nchannel[texture]), model.tex_adr[texture]
    pixels = model.tex_data[begin : begin + width * height * channels]
    colours = pixels.reshape(-1, channels)
    is_rgb = channels >= 3
    rgba = np.full((width * height, 4), 255, "u1")
    rgba[:, :3] = colours[:, :3] if is_rgb else colours[:, :1]
    if channels == 4:
        rgba[:, 3] = colours[:, 3]
    kind = mujoco.mjtTexture(model.tex_type[texture])
    return {
        "kind": kind.name.removeprefix("mjTEXTURE_").lower(),
        "width": width,
        "height": height,
        # A cube texture is drawn as its mean colour.
        "mean": (rgba.mean(axis=0) / 255).tolist(),
        "rgba": "" if kind == mujoco.mjtTexture.mjTEXTURE_CUBE else _packed(rgba),
    }


def _pose(position: Any, quaternion: Any) -> dict[str, list[float]]:
    return {"pos": position.tolist(), "quat": quaternion.tolist()}


def _text(values: Any) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def _packed(values: Any) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 1)).decode()
