"""The picture of one machine: any load's MJCF on a floor with a grid, in good light, seen by a camera that fits it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drive_env.pictures.opengl import OpenGLError, import_mujoco, new_context
from mechanics.arrays import Floats, Image, Integers

FIELD_OF_VIEW = 30.0  # degrees, vertical: a long lens, so that parallel edges look parallel
ELEVATION = -28.0  # degrees: seen from above
TURN = 25.0  # degrees off the view across the longest side
MARGIN = 0.86  # share of the picture that the machine may fill
POSES = 40  # poses that the camera must hold; more say nothing new
SHOWN_GROUPS = 3  # MuJoCo draws groups 0, 1 and 2; collision shapes are in 3 and above

_SURROUNDINGS = """
<mujoco>
  <visual>
    <headlight ambient="0.5 0.5 0.5" diffuse="0.28 0.28 0.28" specular="0.1 0.1 0.1"/>
    <rgba haze="0.93 0.94 0.96 1"/>
    <quality shadowsize="{shadows}" offsamples="{samples}" numslices="64"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.97 0.975 0.985" rgb2="0.9 0.915 0.94" width="64"
             height="384"/>
    <texture name="floor" type="2d" builtin="flat" rgb1="0.86 0.875 0.89" mark="edge" markrgb="0.7 0.72 0.75"
             width="256" height="256"/>
    <material name="floor" texture="floor" texuniform="true" texrepeat="{repeat} {repeat}" specular="0.1"/>
  </asset>
  <worldbody>
    {light}
    {floor}
  </worldbody>
</mujoco>
"""
LIGHT_DIRECTION = np.array([0.35, 0.5, -1.0])
# Shadows fall from the light's position on, even where its rays are parallel: it stands above the machine.
_LIGHT = '<light directional="true" pos="{pos}" dir="0.35 0.5 -1" diffuse="0.42 0.42 0.42" specular="0.2 0.2 0.2"/>'
_FLOOR = '<geom type="plane" size="0 0 1" pos="0 0 {height}" material="floor" contype="0" conaffinity="0"/>'


class Scene:
    """Draws one machine from its joint positions.

    Lights and floor of the load's own MJCF are kept; ours come where it has none.

    Args:
        mjcf: The load's MJCF.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
        poses: Joint positions [rad or m] that the camera must hold, shape (n, D); by default the rest position and
            what limited joints reach.
        quick: Leave out shadows and smooth edges: a tenth of the time where no graphics card draws.

    Raises:
        ValueError: If the MJCF has nothing that can be seen.
        OpenGLError: If there is no OpenGL to draw with.
    """

    def __init__(
        self, mjcf: str | Path, width: int = 480, height: int = 480, poses: ArrayLike | None = None, *,
        quick: bool = False,
    ) -> None:  # fmt: skip
        self._mujoco: Any = import_mujoco()
        self._quick = quick
        bare = load_model(mjcf)
        chosen = _joint_limits(self._mujoco, bare) if poses is None else np.atleast_2d(np.asarray(poses, float))
        self._check_shape(bare, chosen)
        points = _corners(self._mujoco, bare, chosen[_spread(len(chosen), POSES)])
        if not len(points):
            raise ValueError(f"{mjcf} has no geom that can be seen; give its bodies geoms of group 0, 1 or 2")
        low, high = points.min(0), points.max(0)
        self.grid = _round_length(float(np.linalg.norm(high - low)) / 8.0)  # m between two lines of the floor
        self.model: Any = self._with_surroundings(mjcf, bare, low, high)
        self.data: Any = self._mujoco.MjData(self.model)
        self._set_visuals(low, high, width, height)
        self.camera: Any = _camera(self._mujoco, points, low, high, width / height)
        self._size = width, height
        self._context: Any = None
        self._renderer: Any = None
        self._open(width, height)

    def draw(self, position: ArrayLike) -> Image:
        """Return the picture at joint positions [rad or m], shape (D,): uint8 of shape (height, width, 3)."""
        values = np.asarray(position, float)
        self._check_shape(self.model, values[None])
        mujoco = self._mujoco
        self.data.qpos[:] = values
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_tendon(self.model, self.data)
        self._context.make_current()
        mujoco.mjv_updateScene(
            self.model, self.data, self._options, None, self.camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        width, height = self._size
        area = mujoco.MjrRect(0, 0, width, height)
        image = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(area, self._scene, self._renderer)
        mujoco.mjr_readPixels(image, None, area, self._renderer)
        return np.ascontiguousarray(image[::-1])  # OpenGL counts rows from below

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._context is not None:
            self._context.make_current()
            self._renderer.free()
            self._context.free()
            self._context = None

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _with_surroundings(self, mjcf: str | Path, bare: Any, low: Floats, high: Floats) -> Any:
        mujoco = self._mujoco
        size = float(np.linalg.norm(high - low))
        light = 0.5 * (low + high) - size * LIGHT_DIRECTION
        has_floor = bool(np.any(bare.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)))
        text = _SURROUNDINGS.format(
            shadows=256 if self._quick else 2048,
            samples=0 if self._quick else 4,
            repeat=1.0 / self.grid,
            light="" if bare.nlight else _LIGHT.format(pos=" ".join(map(str, light))),
            # A little below the machine, so that what lies on the floor does not flicker.
            floor="" if has_floor else _FLOOR.format(height=float(low[2]) - 0.01 * size),
        )
        scene = mujoco.MjSpec.from_string(text)
        machine = mujoco.MjSpec.from_file(str(mjcf))  # load_model has checked it
        scene.option = machine.option  # MuJoCo warns where they differ; nothing moves here by itself
        scene.attach(machine, prefix="machine/", frame=scene.worldbody.add_frame())
        return scene.compile()

    def _set_visuals(self, low: Floats, high: Floats, width: int, height: int) -> None:
        # The camera's clipping planes and the shadows' range follow the extent, which an endless floor would spoil.
        self.model.stat.extent = float(np.linalg.norm(high - low))
        self.model.stat.center[:] = 0.5 * (low + high)
        self.model.vis.global_.fovy = FIELD_OF_VIEW
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
        self.model.vis.map.shadowclip = 1.0
        self.model.vis.map.znear, self.model.vis.map.zfar = 0.02, 100.0

    def _open(self, width: int, height: int) -> None:
        mujoco = self._mujoco
        self._context = new_context(width, height)
        self._options = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(self.model, maxgeom=10_000)
        if self._quick:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                self._scene.flags[flag] = 0
        try:
            self._renderer = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:
            raise OpenGLError(
                f"OpenGL is there but cannot draw ({error}); set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
            ) from None
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)

    @staticmethod
    def _check_shape(model: Any, positions: Floats) -> None:
        if positions.ndim != 2 or positions.shape[1] != model.nq:
            raise ValueError(f"the machine has {model.nq} joint coordinates; give as many, not {positions.shape[1:]}")


def load_model(mjcf: str | Path) -> Any:
    """Return the compiled model of an MJCF alone, as `mujoco.MjModel`; ValueError as `check_model`."""
    import mujoco  # not import_mujoco(): a model needs no OpenGL

    from mechanics.model import check_model

    check_model(Path(mjcf))
    return mujoco.MjModel.from_xml_path(str(mjcf))


def _joint_limits(mujoco: Any, model: Any) -> Floats:
    """Return the rest position, and one pose for either end of each limited hinge or slide, shape (n, nq)."""
    poses = [np.array(model.qpos0)]
    for joint in range(model.njnt):
        if model.jnt_limited[joint] and model.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            for end in model.jnt_range[joint]:
                pose = np.array(model.qpos0)
                pose[model.jnt_qposadr[joint]] = end
                poses.append(pose)
    return np.array(poses)


def _spread(count: int, wanted: int) -> Integers:
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(np.int64))


def _corners(mujoco: Any, model: Any, poses: Iterable[Floats]) -> Floats:
    """Return the corners of all visible geoms' boxes in all poses [m], shape (n, 3); floors do not count."""
    data = mujoco.MjData(model)
    seen = np.flatnonzero(
        (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
        & (model.geom_group < SHOWN_GROUPS)
        & ((model.geom_rgba[:, 3] > 0.0) | (model.geom_matid >= 0))
    )
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    boxes = model.geom_aabb[seen, None, :3] + signs * model.geom_aabb[seen, None, 3:]  # (geoms, 8, 3)
    found = []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        rotation = data.geom_xmat[seen].reshape(-1, 3, 3)
        found.append((np.einsum("gij,gkj->gki", rotation, boxes) + data.geom_xpos[seen, None]).reshape(-1, 3))
    return np.concatenate(found)


def _camera(mujoco: Any, points: Floats, low: Floats, high: Floats, aspect: float) -> Any:
    """Return the camera nearest to the points that still has all of them in the picture."""
    size = high - low
    azimuth = 90.0 + TURN if size[0] >= size[1] else 180.0 + TURN
    a, e = math.radians(azimuth), math.radians(ELEVATION)
    forward = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    axes = np.stack([right, np.cross(right, forward), forward])  # right, up, forward
    tangent = math.tan(math.radians(FIELD_OF_VIEW / 2.0)) * MARGIN * np.array([aspect, 1.0])
    centre = 0.5 * (low + high)
    distance = 0.0
    for _ in range(4):  # move the centre to the middle of what is seen; that changes the distance a little
        x, y, depth = axes @ (points - centre).T
        distance = float(max((np.abs(x) / tangent[0] - depth).max(), (np.abs(y) / tangent[1] - depth).max()))
        across = np.array([v / (distance + depth) for v in (x, y)])
        middle = 0.5 * (across.max(1) + across.min(1)) * distance
        centre = centre + middle @ axes[:2]
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = centre
    camera.distance, camera.azimuth, camera.elevation = distance, azimuth, ELEVATION
    return camera


def _round_length(length: float) -> float:
    """Return the length of 1, 2 or 5 times a power of ten that is nearest below."""
    power = 10.0 ** math.floor(math.log10(max(length, 1e-6)))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9)))
