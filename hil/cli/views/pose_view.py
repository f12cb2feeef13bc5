"""Output of `hil pose`: the arm's pose, joint by joint, and the outcome of moving each joint by hand."""

from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from hil.config.chain import base_up, described_arm
from hil.config.schema import Config
from hil.description.motion import moves
from hil.printing import print_fitting, result_console
from hil.setup.by_hand import Moved, Pose


def print_pose(config: Config, pose: Pose) -> None:
    """Print each joint's angle in the description's convention and the direction in which it moves the arm's end; then
    print the end's position.
    """
    arm, angles = described_arm(config), np.array(pose.angles)
    table = Table(title=f"{escape(arm.path.name)} as read from the bus", title_justify="left")
    for heading in ("joint", "ID", "angle rad", "degrees", "limits rad", "a positive angle"):
        table.add_column(heading)
    for index, joint in enumerate(config.joints):
        low, high = joint.position_limit
        name, angle = escape(joint.name), pose.angles[index]
        cells = f"{angle:+.3f}", f"{np.degrees(angle):+.1f}", f"{low:g} to {high:g}"
        table.add_row(name, str(joint.id), *cells, moves(arm, angles, index, base_up(config)))
    console = result_console()
    print_fitting(console, table)
    x, y, z = pose.end
    console.print(f"The end link's centre of mass is at x {x:+.3f}, y {y:+.3f}, z {z:+.3f} m from the base.")
    console.print("Is the arm really in this pose? If not, zero_ticks, a direction or the description is wrong.")


def print_moved(moved: Moved) -> None:
    style = "green" if moved.well else "red"
    result_console().print(f"[{style}]{'correct' if moved.well else 'WRONG'}[/]: {escape(moved.found)}.")


def pose_values(config: Config, pose: Pose) -> dict[str, Any]:
    names = [joint.name for joint in config.joints]
    return {"angles": dict(zip(names, pose.angles, strict=True)), "end": list(pose.end)}


def moved_values(moved: Moved) -> dict[str, Any]:
    return {"joint": moved.joint, "asked": moved.asked, "angles": list(moved.angles), "well": moved.well} | {
        "found": moved.found
    }
