"""What the parts of a robot's description must have to do with each other in the tree of its links."""

from __future__ import annotations

from collections.abc import Iterator

from dora.robot.description import Finger, RobotDescription


def faults(robot: RobotDescription) -> Iterator[str]:
    """Sentences about what does not fit: arm, wrist, palm, fingers and hand joints; none for a sound robot."""
    above = [joint.name for joint in robot.model.chain(robot.wrist_link) if joint.moves]
    if list(robot.arm.names) != above:
        yield f"arm.joints must be the moving joints from the root to wrist_link in this order: {_listed(above)}."
        return
    for finger in robot.fingers.values():
        yield from _of_finger(robot, finger)
    owned = {joint for finger in robot.fingers.values() for joint in finger.joints}
    free = [joint for joint in robot.hand.names if joint not in owned]
    if free:
        yield f"the hand joint {free[0]!r} belongs to no finger; name it in fingers.*.joints, or remove it from hand."
    if robot.palm_link in {finger.tip for finger in robot.fingers.values()}:
        yield f"palm_link is {robot.palm_link!r}, the frame of a fingertip; name the link of the palm."


def _of_finger(robot: RobotDescription, finger: Finger) -> Iterator[str]:
    where, model = f"fingers.{finger.name}", robot.model
    root, chain = model.chain(robot.wrist_link), model.chain(finger.tip)
    below = chain[len(root) :]
    if [joint.name for joint in chain[: len(root)]] != [joint.name for joint in root] or not below:
        yield f"{where}.tip is {finger.tip!r}, which is not below wrist_link {robot.wrist_link!r}; correct one of them."
        return
    moving = [joint.name for joint in below if joint.moves]
    if not moving:
        yield f"{where}.tip is {finger.tip!r}, which no joint moves against wrist_link; correct one of them."
    elif list(finger.joints) != moving:
        yield f"{where}.joints must be the moving joints from wrist_link to the tip in this order: {_listed(moving)}."
    links = [joint.child for joint in below]
    for key in ("proximal", "medial", "distal"):
        if getattr(finger, key) not in links[:-1]:
            yield f"{where}.{key} is {getattr(finger, key)!r}, which is not between wrist_link and the tip; correct it."
            return
    places = [links.index(link) for link in finger.links]
    if places != sorted(places):
        yield f"{where}: proximal, medial and distal must follow each other from the palm outwards; exchange them."
    if any(joint.moves for joint in below[places[-1] + 1 :]):
        yield f"{where}.tip is {finger.tip!r}, which is not fixed to the distal link; name its frame."
    if robot.shapes.get(finger.tip) or any(joint.parent == finger.tip for joint in model.joints.values()):
        yield f"{where}.tip is {finger.tip!r}, which has shapes or links below it; name a frame at the end."


def _listed(names: list[str]) -> str:
    return ", ".join(names) or "none"
