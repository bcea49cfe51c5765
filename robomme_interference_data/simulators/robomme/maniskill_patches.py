"""Patch, at run time, a ManiSkill that is not the fork which RoboMME requires.

Runs in RoboMME's own interpreter, as `worker.py` does: nothing of ours is imported, and
nothing of that installation is changed. What is missing is taken from what the installation holds.
"""

import copy
import hashlib
import inspect
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

CAMERA, LINK = "hand_camera", "camera_link"
SIDE = 256  # pixels of the wrist camera in RoboMME's recordings

PLANNER = "stick planner's arguments"
BODY = "camera's body on the stick"
WRIST, STICK = "wrist camera's size", "wrist camera on the stick"


class CannotPatch(Exception):
    """RoboMME cannot play here as it does on its fork of ManiSkill; says why."""


def apply_patches(folder: Path) -> list[str]:
    """Patch what differs from RoboMME's fork of ManiSkill; return what was, in words.

    Args:
        folder: Where the description of an arm may be written, once for all processes.
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
    except CannotPatch:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise CannotPatch(f"its ManiSkill is none that is known: {what}") from error


def _planner(solver: Any) -> list[str]:
    """Make the planner of the stick hand its base what that takes, and no more."""
    base = solver.__mro__[1]
    signature, taken = (inspect.signature(one.__init__) for one in (solver, base))
    for name in ("visualize_target_grasp_pose", "joint_vel_limits"):
        if name not in signature.parameters:
            raise CannotPatch(f"its ManiSkill's {solver.__name__} takes no {name}")

    def trial(*args: Any, **named: Any) -> None:
        taken.bind(*args, **named)

    theirs, base.__init__ = base.__init__, trial
    try:
        solver.__init__(solver.__new__(solver), env=None)
        return []
    except TypeError:
        pass
    finally:
        base.__init__ = theirs

    def init(*args: Any, **named: Any) -> None:
        given = signature.bind(*args, **named)
        given.apply_defaults()
        named = {name: one for name, one in given.arguments.items() if name in taken.parameters}
        base.__init__(**named)

    solver.__init__ = init
    return [PLANNER]


def _body(stick: Any, wrist: Any, folder: Path) -> list[str]:
    """Give the stick arm the body of the camera, as the arm with the wrist camera has it."""
    own, other = _Description(stick.urdf_path), _Description(wrist.urdf_path)
    if LINK in own.links:
        return []
    own.take(LINK, other)
    stick.urdf_path = own.write(folder)
    return [BODY]


def _camera(arm: Any, wrist: Any, what: str) -> list[str]:
    """Give an arm the wrist camera, with as many pixels as in RoboMME's recordings."""
    before, usual = arm._sensor_configs.fget, wrist._sensor_configs.fget

    def hand(configs: list[Any]) -> list[Any]:
        return [one for one in configs if one.uid == CAMERA]

    def sensors(self: Any) -> list[Any]:
        found = list(before(self))
        if not hand(found):
            found += hand(usual(self))
        for one in hand(found):
            one.width = one.height = SIDE
        return found

    # Cameras are those of an arm in a scene; which there are can be asked of one without any.
    nowhere = SimpleNamespace(robot=SimpleNamespace(links_map=defaultdict(lambda: None)))
    sizes = [(one.width, one.height) for one in hand(before(nowhere))]
    if sizes == [(SIDE, SIDE)]:
        return []
    if not hand(sensors(nowhere)):
        raise CannotPatch(f"its ManiSkill has no {CAMERA} on {wrist.__name__}")
    arm._sensor_configs = property(sensors)
    return [what]


class _Description:
    """An arm's URDF file, and the SRDF file beside it, which says which links may touch."""

    def __init__(self, path: str):
        self._path = Path(path)
        self._urdf = ET.parse(self._path).getroot()
        self._srdf = ET.parse(self._path.with_suffix(".srdf")).getroot()

    @property
    def links(self) -> dict[str, Any]:
        """Its links by name."""
        return {one.get("name", ""): one for one in self._urdf.iter("link")}

    def take(self, link: str, other: "_Description") -> None:
        """Take a link from another arm, and all between it and the first link that this one has.

        What its material is, is not taken: on RoboMME's fork the body on the stick is white, too.
        """
        there = other.links
        joints = {_end(one, "child"): one for one in other._urdf.iter("joint")}
        new: list[str] = []
        while link not in self.links:
            if link not in there or link not in joints:
                raise CannotPatch(f"{other._path} has no {LINK} that {self._path} can take")
            new.append(link)
            self._urdf.append(copy.deepcopy(joints[link]))
            self._urdf.append(copy.deepcopy(there[link]))
            link = _end(joints[link], "parent")
        for one in other._srdf.iter("disable_collisions"):
            pair = {one.get("link1"), one.get("link2")}
            if pair & {*new} and pair <= self.links.keys():
                self._srdf.append(copy.deepcopy(one))

    def write(self, folder: Path) -> str:
        """Write it beside links to what its own folder holds; return the path of the URDF file."""
        urdf, srdf = (ET.tostring(one) for one in (self._urdf, self._srdf))
        home = self._path.resolve().parent
        name = hashlib.sha256(b"\0".join([bytes(home), urdf, srdf])).hexdigest()
        out = folder / name
        if not out.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            partial = Path(tempfile.mkdtemp(prefix=f".{name}.", suffix=".partial", dir=folder))
            for one in home.iterdir():
                (partial / one.name).symlink_to(one)
            for path, text in ((self._path, urdf), (self._path.with_suffix(".srdf"), srdf)):
                (partial / path.name).unlink()
                (partial / path.name).write_bytes(text)
            try:
                partial.rename(out)
            except OSError:  # another process was faster
                shutil.rmtree(partial)
        return str(out / self._path.name)


def _end(joint: Any, which: str) -> str:
    """Return the link at an end of a joint: `child` or `parent`."""
    return str(joint.find(which).get("link"))
