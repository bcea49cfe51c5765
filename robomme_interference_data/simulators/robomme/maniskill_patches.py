"""Patch, at run time, a ManiSkill that is not the fork that RoboMME requires.

Runs in RoboMME's interpreter, as `worker.py` does, so it does not import this package. The
installation is not changed; missing parts are taken from its other parts.
"""

import copy
import hashlib
import inspect
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

CAMERA, LINK = "hand_camera", "camera_link"
SIDE = 256  # pixels of the wrist camera in RoboMME's recordings

PLANNER = "stick planner's arguments"
BODY = "camera's body on the stick"
WRIST, STICK = "wrist camera's size", "wrist camera on the stick"


class CannotPatch(Exception):
    """This ManiSkill cannot be made to behave as RoboMME's fork does."""


class CannotWrite(Exception):
    """A patched file cannot be written."""


def apply_patches(folder: Path) -> list[str]:
    """Patch what differs from RoboMME's fork of ManiSkill; return descriptions of the patches.

    The patched description of an arm is written to `folder`, once for all processes.
    """
    try:
        from mani_skill.agents.robots.panda import PandaStick, PandaWristCam
        from mani_skill.examples.motionplanning.panda.motionplanner_stick import (
            PandaStickMotionPlanningSolver,
        )

        return [
            *_planner(PandaStickMotionPlanningSolver),
            *_body(PandaStick, PandaWristCam, folder),
            *_camera(PandaStick, PandaWristCam, STICK),
            *_camera(PandaWristCam, PandaWristCam, WRIST),
        ]
    except (CannotPatch, CannotWrite):
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise CannotPatch(f"its ManiSkill is not supported: {what}") from error


def _planner(solver: Any) -> list[str]:
    """Make the stick's planner pass its base class only the arguments that this accepts."""
    base = solver.__mro__[1]
    signature, accepted = (inspect.signature(kind.__init__) for kind in (solver, base))
    for name in ("visualize_target_grasp_pose", "joint_vel_limits"):
        if name not in signature.parameters:
            raise CannotPatch(f"its ManiSkill's {solver.__name__} takes no {name}")

    def trial(*args: Any, **named: Any) -> None:
        accepted.bind(*args, **named)

    original, base.__init__ = base.__init__, trial
    try:
        solver.__init__(solver.__new__(solver), env=None)
        return []
    except TypeError:
        pass
    finally:
        base.__init__ = original

    def init(*args: Any, **named: Any) -> None:
        bound = signature.bind(*args, **named)
        bound.apply_defaults()
        base.__init__(**{k: v for k, v in bound.arguments.items() if k in accepted.parameters})

    solver.__init__ = init
    return [PLANNER]


def _body(stick: Any, wrist: Any, folder: Path) -> list[str]:
    """Add the camera's body of the arm with the wrist camera to the arm with the stick."""
    description = _Description(stick.urdf_path)
    if LINK in description.links:
        return []
    description.take(LINK, _Description(wrist.urdf_path))
    stick.urdf_path = description.write(folder)
    return [BODY]


def _camera(arm: Any, wrist: Any, what: str) -> list[str]:
    """Add the wrist camera to an arm, with the resolution of RoboMME's recordings."""
    before, usual = arm._sensor_configs.fget, wrist._sensor_configs.fget

    def hand(configs: list[Any]) -> list[Any]:
        return [config for config in configs if config.uid == CAMERA]

    def sensors(self: Any) -> list[Any]:
        configs = list(before(self))
        if not hand(configs):
            configs += hand(usual(self))
        for config in hand(configs):
            config.width = config.height = SIDE
        return configs

    # The property needs an arm in a scene; this stand-in suffices to list its cameras.
    nowhere = SimpleNamespace(robot=SimpleNamespace(links_map=defaultdict(lambda: None)))
    sizes = [(config.width, config.height) for config in hand(before(nowhere))]
    if sizes == [(SIDE, SIDE)]:
        return []
    if not hand(sensors(nowhere)):
        raise CannotPatch(f"its ManiSkill has no {CAMERA} on {wrist.__name__}")
    arm._sensor_configs = property(sensors)
    return [what]


class _Description:
    """An arm's URDF file, and the SRDF file beside it, which lists the links that may touch."""

    def __init__(self, path: str):
        self._path = Path(path)
        self._urdf = ET.parse(self._path).getroot()
        self._srdf = ET.parse(self._path.with_suffix(".srdf")).getroot()

    @property
    def links(self) -> dict[str, Any]:
        """Its links by name."""
        return {link.get("name", ""): link for link in self._urdf.iter("link")}

    def take(self, link: str, other: "_Description") -> None:
        """Copy a link from another arm, and all links between it and the first common one.

        Materials are not copied: on RoboMME's fork the camera's body on the stick is white, too.
        """
        links = other.links
        joints = {_end(joint, "child"): joint for joint in other._urdf.iter("joint")}
        new: list[str] = []
        while link not in self.links:
            if link not in links or link not in joints:
                raise CannotPatch(f"{other._path} has no {LINK} to copy to {self._path}")
            new.append(link)
            self._urdf.append(copy.deepcopy(joints[link]))
            self._urdf.append(copy.deepcopy(links[link]))
            link = _end(joints[link], "parent")
        for rule in other._srdf.iter("disable_collisions"):
            pair = {rule.get("link1"), rule.get("link2")}
            if pair & {*new} and pair <= self.links.keys():
                self._srdf.append(copy.deepcopy(rule))

    def write(self, folder: Path) -> str:
        """Write both files beside links to the arm's other files; return the path of the URDF."""
        urdf, srdf = (ET.tostring(tree) for tree in (self._urdf, self._srdf))
        home = self._path.resolve().parent
        name = hashlib.sha256(b"\0".join([bytes(home), urdf, srdf])).hexdigest()
        out = folder / name
        if not out.is_dir():
            texts = {self._path.name: urdf, self._path.with_suffix(".srdf").name: srdf}
            try:
                folder.mkdir(parents=True, exist_ok=True)
                _write_beside_links(out, home, texts)
            except OSError as error:
                what = f"the folder {folder} cannot be written: {error.strerror}"
                raise CannotWrite(what) from error
        return str(out / self._path.name)


def _write_beside_links(out: Path, home: Path, texts: dict[str, bytes]) -> None:
    """Write files to a new folder, beside links to all other files of another one."""
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        for path in home.iterdir():
            if path.name not in texts:
                (partial / path.name).symlink_to(path)
        for name, text in texts.items():
            (partial / name).write_bytes(text)
        with suppress(OSError):  # another process was faster
            partial.rename(out)
    finally:
        if partial.exists():
            shutil.rmtree(partial)


def _end(joint: Any, which: str) -> str:
    """Return the link at an end of a joint, `child` or `parent`."""
    return str(joint.find(which).get("link"))
