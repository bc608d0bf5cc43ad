"""Cameras whose pictures are observations: their records, ManiSkill's configurations of them, and checks."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isfinite, pi
from typing import Any, TypeGuard

import numpy as np
from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES, ObservationModeStruct
from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Link

from dora.errors import InputError, shown, suggestion
from dora.sim.batch.rendering import wants_pictures

Point = tuple[float, float, float]
"""A point or a direction; points in [m]."""
MOST_PIXELS = 4096
"""Largest width and height of a picture [pixels]."""
FIELDS = tuple(field.name for field in fields(CameraConfig))
"""What `sensor_configs` may set of a camera."""
KNOWN, FARTHEST = (*FIELDS, "use_stereo_depth"), 1e6
"""The same and ManiSkill's own word beside them; largest depth that is drawn [m]."""
DRAWN = ("rgb", "depth", "segmentation", "position")
"""Textures that ManiSkill's fastest shader, "minimal", draws; "default" draws the others as well."""
SHOWN = ("rgb", "depth", "segmentation", "position")
"""Textures that `render_mode="sensors"` can show."""


@dataclass(frozen=True)
class CameraSpec:
    """A camera of a task, in the world or on a hand.

    Attributes:
        eye, target: where it is and what it looks at [m]: in the frame of the hand's wrist link, with which it moves,
            if `on_hand`, and in the world otherwise.
        up: direction that is up in the picture, in the same frame.
        on_hand: whether it is mounted on the hand; with several arms each hand has one.
        width, height: size of its picture [pixels].
        fov: vertical angle of view [rad].
        near, far: nearest and farthest depth that is drawn [m].
    """

    eye: Point
    target: Point
    up: Point = (0.0, 0.0, 1.0)
    on_hand: bool = False
    width: int = 128
    height: int = 128
    fov: float = 1.0
    near: float = 0.01
    far: float = 10.0

    def config(self, name: str, textures: Any, mount: Link | None = None) -> CameraConfig:
        """ManiSkill's configuration of this camera.

        Args:
            name: of the camera in observations.
            textures: which are observed (`ObservationModeStruct.visual`); they choose the shader.
            mount: the link that carries it, of all environments; None for one in the world.
        """
        pose = sapien_utils.look_at(list(self.eye), list(self.target), list(self.up))
        plain = all(texture in DRAWN for texture in ALL_VISUAL_TEXTURES if getattr(textures, texture))
        return CameraConfig(
            name, pose, self.width, self.height, self.fov, self.near, self.far,
            mount=mount,  # pyright: ignore[reportArgumentType]
            shader_pack="minimal" if plain else "default",
        )  # fmt: skip


def camera_configs(
    specs: Mapping[str, CameraSpec], wrists: Mapping[str, Link], mode: ObservationModeStruct
) -> list[CameraConfig]:
    """ManiSkill's configurations of a task's cameras.

    Args:
        specs: the cameras by name.
        wrists: the wrist link of each arm by the arm's name. With several arms `hand_camera` becomes
            `left_hand_camera` and so on.
        mode: what is observed.
    """
    out = []
    for name, spec in specs.items():
        mounts: Mapping[str, Link | None] = wrists if spec.on_hand else {"": None}
        for arm, link in mounts.items():
            own = f"{arm}_{name}" if link is not None and len(wrists) > 1 else name
            out.append(spec.config(own, mode.visual, link))
    return out


# ---- checks --------------------------------------------------------------------------------------


def check_settings(configs: Mapping[str, Any], what: str = "sensor_configs") -> None:
    """Refuses settings of cameras that cannot be drawn, such as `sensor_configs`, with or without a driver.

    Args:
        configs: settings of all cameras, and dictionaries of settings by the names of cameras.
        what: their name, for the message.

    Raises:
        InputError: naming the first of them.
    """
    for name, value in configs.items():
        if isinstance(value, Mapping):
            check_settings(value, f"{what}[{name!r}]")
        elif name in ("width", "height") and not (_is_number(value, whole=True) and 1 <= int(value) <= MOST_PIXELS):
            raise InputError(f"the {name} of a camera is {shown(value)}: it must be from 1 to {MOST_PIXELS} pixels.")
        elif name == "fov" and value is not None and not (_is_number(value) and 0 < value < pi):
            raise InputError(f"the fov of a camera is {shown(value)}: it must lie between 0 and pi [rad].")
        elif name in ("near", "far") and not (_is_number(value) and 0 < value <= FARTHEST):
            raise InputError(f"{name} of a camera is {shown(value)}: it must be above 0 and at most {FARTHEST:g} [m].")
        elif name == "shader_pack" and value not in PREBUILT_SHADER_CONFIGS:
            raise InputError(f"there is no shader_pack {shown(value)}: {suggestion(value, PREBUILT_SHADER_CONFIGS)}")
        elif name not in KNOWN:
            more = "; settings of one camera are a dictionary, by its name."
            raise InputError(f"{what} has no {name!r}: {suggestion(name, KNOWN).rstrip('.')}{more}")
    near, far = float(configs.get("near", 0.0)), float(configs.get("far", FARTHEST))
    if not near < far:
        raise InputError(f"near is {near} m and far {far} m: a camera draws what lies between them.")


def _is_number(value: Any, whole: bool = False) -> TypeGuard[float]:
    """Whether a value is a finite number, of Python or NumPy."""
    kinds = (int, np.integer) if whole else (int, float, np.integer, np.floating)
    return isinstance(value, kinds) and not isinstance(value, bool) and isfinite(value)


def check_names(configs: Mapping[str, Any], cameras: Mapping[str, Any]) -> None:
    """Refuses entries of `sensor_configs` that are neither a camera nor a setting of one.

    Raises:
        InputError: naming the first of them, with the nearest known name.
    """
    for name, value in configs.items():
        if name in cameras:
            wrong = next((own for own in value if own not in KNOWN), None)
            if wrong is not None:
                raise InputError(f"sensor_configs[{name!r}] has no {wrong!r}: {suggestion(wrong, KNOWN)}")
        elif name not in KNOWN:
            raise InputError(f"there is no camera {name!r}: {suggestion(name, (*cameras, *KNOWN))}")


def check_cameras(env: Any) -> None:
    """Refuses an observation mode of which the cameras of a built environment draw nothing, or a part only.

    Raises:
        InputError: there is no camera, or a shader draws less than is observed.
    """
    if not wants_pictures(env.obs_mode):
        return
    if not env._sensors:
        raise InputError(
            f"{type(env).__name__} has no camera, so that obs_mode {env.obs_mode!r} would observe no picture: "
            'use obs_mode "state", or a task or robot with cameras.'
        )
    for name, sensor in env._sensors.items():
        shader = sensor.config.shader_config
        drawn = {texture for textures in shader.texture_names.values() for texture in textures}
        wanted = [t for t in ALL_VISUAL_TEXTURES if getattr(env.obs_mode_struct.visual, t)]
        if lacking := [texture for texture in wanted if texture not in drawn]:
            raise InputError(
                f"the shader {shader.shader_pack!r} of the camera {name!r} draws no {lacking[0]}: "
                'pass sensor_configs={"shader_pack": "default"}.'
            )


def check_shown(env: Any) -> None:
    """Refuses to show what the sensors observe where that is no picture.

    Raises:
        InputError: there is no camera, or the observation mode has no texture that can be shown.
    """
    if not env._sensors:
        raise InputError(f'{type(env).__name__} has no camera to show: use render_mode "rgb_array".')
    visual = env.obs_mode_struct.visual
    if env.obs_mode not in ("state", "state_dict") and not any(getattr(visual, texture) for texture in SHOWN):
        raise InputError(
            f'render_mode "sensors" shows what is observed, and obs_mode {env.obs_mode!r} has none of '
            f'{", ".join(SHOWN)}: use another obs_mode, or render_mode "rgb_array".'
        )
